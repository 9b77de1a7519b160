"""Test whether camera and robot stand still, from two pictures and the poses around them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..detection import Detection
from ..geometry import host_rotation_angles
from ..viewpoints import TYPICAL_NOISE

MIN_COMMON_POINTS = 4
"""Smallest number of points in both pictures by which a motion can be told from noise."""

FALSE_ALARMS = 0.01
"""Probability that noise alone is taken for a motion; the test is then simply repeated."""

AFFINE_PARAMETERS = 6
"""Parameters of a small motion in the picture: shift, turn, growth and shear."""


class SettleTest(NamedTuple):
    """The result of a settle test.

    Attributes:
        is_settled: whether the view may be taken.
        reason: why it may not; empty if it may.
        motion: mean displacement of the target between the two pictures, px; NaN if unknown.
        noise: noise of one point, as the two pictures tell it, px; NaN if unknown.
    """

    is_settled: bool
    reason: str
    motion: float = float("nan")
    noise: float = float("nan")


def settle_test(
    first: Detection,
    second: Detection,
    before: Float[np.ndarray, "4 4"],
    after: Float[np.ndarray, "4 4"],
) -> SettleTest:
    """Return whether a view stands still.

    The motion of the target between two pictures is an affine map of its points. It counts if it is
    both significant (an F test against the scatter of the points about it) and larger than the
    noise of a point, below which it harms nothing. The pose may change by less than the error that
    an industrial arm has anyway (`viewpoints.TYPICAL_NOISE`).

    Args:
        first, second: the target in two pictures, one after the other.
        before, after: the robot's reports before the first and after the second picture.
    """
    for detection in (first, second):
        if detection.reason is not None:
            return SettleTest(False, f"target not found: {detection.reason}")
    common = first.visible & second.visible
    count = int(common.sum())
    if count < MIN_COMMON_POINTS:
        return SettleTest(False, f"only {count} points of the target are in both pictures")
    moves, motion, noise = _motion(first.pixels[common], second.pixels[common])
    distance = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    turn = float(host_rotation_angles(before, after))
    if distance > TYPICAL_NOISE.translation or turn > TYPICAL_NOISE.rotation:
        return SettleTest(
            False,
            f"the robot moves: its report changed by {1e3 * distance:.2f} mm and "
            f"{np.rad2deg(turn):.3f} degrees",
            motion,
            noise,
        )
    if moves:
        return SettleTest(
            False,
            f"the target moves in the picture: {motion:.2f} px, noise {noise:.2f} px",
            motion,
            noise,
        )
    return SettleTest(True, "", motion, noise)


def _motion(
    first: Float[np.ndarray, "points 2"], second: Float[np.ndarray, "points 2"]
) -> tuple[bool, float, float]:
    """Return whether points move between two pictures, by how much and the points' noise, px."""
    # Imported here: it takes a tenth of a second.
    from scipy.stats import f

    count = len(first)
    middle = first - first.mean(axis=0)
    design = np.column_stack([np.ones(count), middle / max(float(np.abs(middle).max()), 1.0)])
    solution, *_ = np.linalg.lstsq(design, second - first, rcond=None)
    fitted = design @ solution
    freedom = 2 * count - AFFINE_PARAMETERS
    # Of a displacement, which has the noise of two pictures.
    variance = float(np.sum((second - first - fitted) ** 2)) / freedom
    motion, noise = float(np.sqrt(np.mean(np.sum(fitted**2, axis=1)))), np.sqrt(0.5 * variance)
    limit = f.isf(FALSE_ALARMS, AFFINE_PARAMETERS, freedom)
    is_significant = np.sum(fitted**2) > limit * AFFINE_PARAMETERS * variance
    return bool(is_significant and motion > noise), motion, float(noise)
