"""A camera that circles over a target at some centimetres a second, for robots that log poses."""

import numpy as np

import smartview_jax as sv
from smartview_jax.geometry import viewing_direction
from smartview_jax.simulation import paper_calibration


def circling_commands(seconds, points, phases=(0.0, 0.0, 0.0, 0.0)):
    """Return the robot's poses at some times; phases are of tilt, roll, distance and turn."""
    tilt = 0.3 + 0.2 * np.sin(0.8 * seconds + phases[0])
    roll = 0.8 * np.sin(0.5 * seconds + phases[1])
    distance = 0.25 + 0.03 * np.sin(0.6 * seconds + phases[2])
    direction = viewing_direction(tilt, 0.6 * seconds + phases[3])
    aims = np.broadcast_to(points.mean(axis=0), (len(seconds), 3))
    return paper_calibration().command_for(sv.look_at(aims, direction, distance, roll))
