"""Name a unit of length that was mistaken for another, by the lengths of motions or distances."""

import math

import numpy as np

from .closure import Poses
from .transform_fit import median_distance

LENGTH_UNIT_MISTAKES = {
    1e-3: "the robot's positions look like millimetres where metres are expected",
    1e-2: "the robot's positions look like centimetres where metres are expected",
    0.0254: "the robot's positions look like inches where metres are expected",
    1.0 / 25.4: "the robot's positions look like millimetres where inches are stated, or the "
    "target's points like inches where millimetres are",
    0.1: "the robot's positions look like millimetres where centimetres are stated, or the "
    "target's points like centimetres where millimetres are",
    10.0: "the robot's positions look like centimetres where millimetres are stated, or the "
    "target's points like millimetres where centimetres are",
    25.4: "the robot's positions look like inches where millimetres are stated, or the target's "
    "points like millimetres where inches are",
    1.0 / 0.0254: "the target's points look like inches where metres are expected, or the robot's "
    "positions like metres where inches are stated",
    1e2: "the target's points look like centimetres where metres are expected, or the robot's "
    "positions like metres where centimetres are stated",
    1e3: "the target's points look like millimetres where metres are expected, or the robot's "
    "positions like metres where millimetres are stated",
}
"""Explanations in words, by the ratio of camera motion to robot motion."""

_SMALL_UNIT_MISTAKES = {
    0.3048: "the robot's positions look like feet where metres are expected",
    1.0 / 2.54: "the robot's positions look like centimetres where inches are stated, or the "
    "target's points like inches where centimetres are",
    2.54: "the robot's positions look like inches where centimetres are stated, or the target's "
    "points like centimetres where inches are",
    1.0 / 0.3048: "the target's points look like feet where metres are expected, or the robot's "
    "positions like metres where feet are stated",
}
"""The same for ratios that another size of the target may have, too."""

UNIT_TOLERANCE = 0.05
"""Largest relative difference between a ratio of motions and the ratio of two units named for it.

The ratio is as good as the camera's focal length, which a few views tell to some percent."""

MAX_UNIT_ERROR = 0.2
"""The same where units are all that can differ so much: halfway between two of them."""

MAX_PLAUSIBLE_DISTANCE = 30.0
"""Distance in metres beyond the reach of any arm and beyond any target's distance."""

_ESTIMATED_UNIT = "Have it estimated (scale=True, or smartview calibrate --free target_scale)"


def mistaken_unit(ratio: float, tolerance: float = UNIT_TOLERANCE) -> str:
    """Return which unit was mistaken for which, in words, or nothing if the ratio is of none.

    Args:
        ratio: of the camera's motion to the robot's.
        tolerance: largest relative difference from the ratio of the units.
    """
    if not ratio > 0.0:
        return ""
    units = LENGTH_UNIT_MISTAKES | _SMALL_UNIT_MISTAKES
    nearest = min(units, key=lambda unit: abs(math.log(ratio / unit)))
    return units[nearest] if abs(math.log(ratio / nearest)) < tolerance else ""


def length_unit_problems(
    ratio: float, robot: Poses, camera: Poses, used: np.ndarray, tracked: bool = False
) -> tuple[str, ...]:
    """Return problems with units of length, by the ratio of motions or by impossible distances.

    Args:
        ratio: of the camera's motion to the robot's.
        robot, camera: the poses.
        used: mask of the views to use.
        tracked: whether a tracker gave the camera's poses, whose unit may be its own.
    """
    if not 0.2 < ratio < 5.0:
        words = mistaken_unit(ratio, MAX_UNIT_ERROR)
        if tracked and not words:
            return (
                f"the tracker moved {ratio:.3g} times as far as the robot: its unit of length is "
                f"its own, as of a single moving camera. {_ESTIMATED_UNIT}",
            )
        words = words or "robot positions and target points are not in the same unit"
        # A single moving camera has any unit, also one near a factor of ten.
        own = (
            ". If the robot's positions are right, the tracker's unit may be its own, as of a "
            f"single moving camera. {_ESTIMATED_UNIT}"
            if tracked and median_distance(robot[used]) < MAX_PLAUSIBLE_DISTANCE
            else ""
        )
        return (f"{words}: the camera moved {ratio:.3g} times as far as the robot{own}",)
    # Both may be in the same wrong unit: their ratio is then 1, and only the distances show it.
    problems = []
    for poses, template in (
        (robot, "the tool is reported {:.0f} m from the base"),
        (camera, "the target seems to be {:.0f} m from the camera"),
    ):
        distance = median_distance(poses[used])
        if distance > MAX_PLAUSIBLE_DISTANCE:
            problems.append(f"{template.format(distance)}: millimetres where metres are expected?")
    return tuple(problems)


def size_doubt(camera: Poses, used: np.ndarray) -> str:
    """Return that the target's size is taken as stated, and what an error of it does, in words.

    Args:
        camera: the camera's poses.
        used: mask of the views to use.
    """
    distance = 1e3 * median_distance(camera[used])
    return (
        "these views do not tell the target's size, because the robot turns about one point: it is "
        "taken as stated, and if it is 1 % larger, the camera or the target is up to "
        f"{0.01 * distance:.2g} mm elsewhere. Measure the target, or vary the camera's distance"
    )
