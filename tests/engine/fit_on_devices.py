"""Fits on all devices of one or several processes, as a program of its own; prints JSON.

JAX reads how many devices there are when it starts, so the tests cannot do this themselves.
"""

import json
import re
import sys

import equinox as eqx
import jax

address, count, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
jax.distributed.initialize(address, num_processes=count, process_id=number)

from fits_to_compare import (  # noqa: E402
    described,
    described_rig,
    many,
    one_fit,
    problem_without_corrections,
    rig_fit,
)

from smartview_jax.engine.sharding import shard  # noqa: E402

fit = one_fit(jax.devices())


def views_on_each(problem, devices):
    dealt = shard(problem, devices).observations.visible.addressable_shards
    return [len(part.data) for part in dealt]


def exchanges_of_a_step(problem, devices):
    """The kinds of instructions by which devices exchange numbers when a step is linearised."""
    sharded = shard(problem, devices)
    arrays, rest = eqx.partition(sharded, eqx.is_array)

    def linearised(arrays, z):
        """The equations of all views."""
        return eqx.combine(arrays, rest).normal_equations_without_priors(z)

    program = jax.jit(linearised).lower(arrays, sharded.zero_step()).compile().as_text()
    kinds = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter"
    return sorted(set(re.findall(rf" ({kinds})(?:-start)?\(", program)))


answer = {
    "devices": jax.device_count(),
    "fit": described(fit),
    "rig": described_rig(rig_fit(jax.devices())),
    "views_here": views_on_each(fit.problem, jax.devices()),
    # Without corrections there are no other arrays by views.
    "uncorrected_views_here": views_on_each(problem_without_corrections(), jax.local_devices()),
}
if number == 0:
    # On the devices of this process alone.
    answer["exchanges"] = exchanges_of_a_step(fit.problem, jax.local_devices())
    answer["many"] = many(jax.local_devices())
sys.stdout.write(f"{json.dumps(answer)}\n")
