"""This library's default calibration of simulated views of a board: seconds, and peak memory."""

import sys
import time

START = time.perf_counter()

import smartview_jax as sv  # noqa: E402
from smartview_jax.simulation import random_scene  # noqa: E402
from smartview_jax.targets import Chessboard  # noqa: E402

from .result import report, timed  # noqa: E402

TRANSLATION, ROTATION = 5e-5, 1e-4
"""Standard deviations of the robot's noise, m and rad, for a good arm."""


def main(views: int, repeats: int) -> None:
    """Time the default call, cold and warm, on views of 63 points."""
    board = Chessboard(7, 9, 0.004).points
    scene = random_scene(0, views, board, translation_noise=TRANSLATION, rotation_noise=ROTATION)
    fit, seconds, cold = timed(lambda: sv.calibrate(scene.data), repeats, START)
    solution = fit.joint.solution
    report(seconds, solution.costs[-1], solution.steps, cold)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
