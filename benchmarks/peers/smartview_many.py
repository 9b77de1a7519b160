"""This library on many small problems at once: seconds and cost of one of them."""

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


def main(path: Path, repeats: int, devices: int) -> None:
    """Time one call for all of them, cold and warm, on so many of the CPU's devices."""
    jax.config.update("jax_num_cpu_devices", devices)
    first = peer.load(path)
    views, count = first.pixels.shape[:2]
    problems = [first, *(peer.make(views, count, False, seed) for seed in range(1, MANY))]
    data = [dataset_of(one) for one in problems]
    starts = [calibration_of(one, "forward") for one in problems]
    chosen = None if devices == 1 else jax.devices()
    found, seconds, cold = timed(
        lambda: jax.block_until_ready(sv.fit_many(data, starts, devices=chosen)), repeats, START
    )
    assert float(found.converged.mean()) > 0.99, "many fits did not converge"
    each = [s / MANY for s in seconds]
    report(each, float(found.cost[0]) * peer.PIXEL**-2, float(found.steps.mean()), cold)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
