"""This library on one problem, with its views on so many of the CPU's devices."""

import os
import sys
import time
from pathlib import Path

START = time.perf_counter()

COMMAND = [sys.executable, "-m", "benchmarks.peers.smartview_on"]


def main(path: Path, repeats: int, devices: int) -> None:
    """Time one fit, cold and warm."""
    import jax

    from smartview_jax.joint.build import build_problem
    from smartview_jax.joint.sharding import deal_out
    from smartview_jax.joint.solver import solve

    from . import problem as peer
    from .result import report, timed
    from .smartview import calibration_of, dataset_of

    data = peer.load(path)
    built = build_problem(dataset_of(data), calibration_of(data, "forward")).problem
    del data
    if devices > 1:
        built = deal_out(built, jax.devices())
    (solution, _), seconds, cold = timed(
        lambda: jax.block_until_ready(solve(built)), repeats, START
    )
    report(seconds, solution.costs[-1] * peer.PIXEL**-2, solution.steps, cold)


if __name__ == "__main__":
    # JAX reads this when it starts.
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={sys.argv[3]}"
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
