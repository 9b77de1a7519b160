"""Fits on all devices of one or several processes, as a program of its own; prints JSON.

JAX reads how many devices there are when it starts, so the tests cannot do this themselves.
"""

import json
import sys

import jax

address, count, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
if count > 1:
    jax.distributed.initialize(address, num_processes=count, process_id=number)

from fits_to_compare import described, many, one_fit, problem_without_corrections  # noqa: E402

from smartview_jax.engine.sharding import shard  # noqa: E402

answer = {"devices": jax.device_count(), "fit": None, "many": None}
if count > 1:
    fit = one_fit(jax.devices())
    problem, answer["fit"] = fit.problem, described(fit)
else:
    # Results of many fits stay with the process that made them.
    problem, answer["many"] = problem_without_corrections(), many(jax.devices())
dealt = shard(problem, jax.devices()).observations.visible.addressable_shards
answer["views_here"] = [len(part.data) for part in dealt]
sys.stdout.write(f"{json.dumps(answer)}\n")
