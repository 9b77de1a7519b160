"""This library on many small problems at once: seconds and cost of one of them.

The seconds of its compiled program alone are printed too, without the host's work around it.
"""

import sys
import time
from pathlib import Path

START = time.perf_counter()

import jax  # noqa: E402

import smartview_jax as sv  # noqa: E402

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402
from .smartview import calibration_of, dataset_of  # noqa: E402

MANY = 1000


def main(path: Path, repeats: int, devices: int, count: int) -> None:
    """Time one call for all of them, cold and warm, on so many of the CPU's devices."""
    jax.config.update("jax_num_cpu_devices", devices)
    # Imported here, because the number of devices cannot be set afterwards.
    from smartview_jax.joint import many

    first = peer.load(path)
    views, points = first.pixels.shape[:2]
    problems = [first, *(peer.make(views, points, False, seed) for seed in range(1, count))]
    data = [dataset_of(one) for one in problems]
    starts = [calibration_of(one, "forward") for one in problems]
    chosen = None if devices == 1 else jax.devices()
    program, device_seconds = many.solve_all, []

    def timed_program(*arguments):
        began = time.perf_counter()
        results = jax.block_until_ready(program(*arguments))
        device_seconds.append(time.perf_counter() - began)
        return results

    many.solve_all = timed_program
    found, seconds, cold = timed(
        lambda: jax.block_until_ready(sv.fit_many(data, starts, devices=chosen)), repeats, START
    )
    assert float(found.converged.mean()) > 0.99, "many fits did not converge"
    each = [s / count for s in seconds]
    batches = len(device_seconds) // (1 + len(seconds))
    alone = sum(device_seconds[-batches:]) / count
    cost, steps = float(found.cost[0]) * peer.PIXEL**-2, float(found.steps.mean())
    report(each, cost, steps, cold, device_seconds=alone)


if __name__ == "__main__":
    path, repeats, devices, *count = sys.argv[1:]
    main(Path(path), int(repeats), int(devices), *map(int, count or [MANY]))
