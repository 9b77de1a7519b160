"""Compute the probability that a grasp succeeds, from uncertainties and the gripper's clearance.

Let eta be the small displacement of the object from where the gripper expects it, as a twist in the
gripper's frame, and tau the part of it due to the gripper's own error. Each condition is linear:

    fingers pass the object           |eta_x + theta_y z - theta_z y| <= (opening - width) / 2
                                      - tolerance, at the corners (y, z) of the finger's contact
    the object is deep enough         eta_z <= depth - min_hold
    the palm does not touch it        -eta_z <= finger_length - depth
    the fingers overlap its sides     by half of the possible overlap, along y
    closing straightens it            |theta_y|, |theta_z| <= max_turn
    nothing else is touched           |tau_x|, |tau_y|, |tau_z| <= clearance

The probability of all together is the integral of a Gaussian over a polytope, computed with a
scrambled Sobol sequence (quasi-Monte-Carlo, Genz and Bretz, Computation of multivariate normal and
t probabilities, 2009). Friction, and the motion of an object that the fingers push, are ignored.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from ..robots import Gripper
from .candidates import Candidate

LOG2_DRAWS = 13
"""Binary logarithm of the number of draws; the error of a probability is then about 0.001."""


class Conditions(NamedTuple):
    """Linear conditions `matrix @ errors <= bounds` on the twelve errors of a grasp.

    Attributes:
        matrix: its columns are eta (translation, rotation), then tau.
        bounds: m and rad.
        names: one for each condition.
    """

    matrix: Float[np.ndarray, "conditions 12"]
    bounds: Float[np.ndarray, "conditions"]
    names: tuple[str, ...]


def grasp_conditions(
    candidate: Candidate, gripper: Gripper, clearance: float = np.inf
) -> Conditions:
    """Return the conditions of a successful grasp, at a clearance (m) from obstacles."""
    # Each condition is a row of the matrix; |x| <= b makes two.
    rows: list[tuple[np.ndarray, float, str]] = []

    def require(coefficients: dict[str, float], bound: float, name: str, both: bool = True) -> None:
        row = np.zeros(12)
        for axis, value in coefficients.items():
            row[_COLUMNS[axis]] = value
        rows.append((row, bound, name))
        if both:
            rows.append((-row, bound, name))

    depth = candidate.grasp.depth
    room = 0.5 * (candidate.opening - candidate.width) - gripper.tolerance
    half_finger = 0.5 * gripper.finger_width
    low, high = np.clip(candidate.along_finger, -half_finger, half_finger).tolist()
    # A side of the object at (y, z) moves along x by eta_x + (theta x p)_x.
    for y in (low, high):
        for z in (-depth, 0.0):
            require({"eta_x": 1.0, "theta_y": z, "theta_z": -y}, room, "not between the fingers")
    require({"eta_z": 1.0}, depth - gripper.min_hold, "too shallow", both=False)
    require({"eta_z": -1.0}, gripper.finger_length - depth, "under the palm", both=False)
    # The overlap of [low, high] with the finger, [-h, h], shrinks as the object moves.
    side_low, side_high = candidate.along_finger
    overlap = 0.5 * (high - low)
    require({"eta_y": 1.0}, half_finger - overlap - side_low, "past the fingers", both=False)
    require({"eta_y": -1.0}, half_finger - overlap + side_high, "past the fingers", both=False)
    require({"theta_y": 1.0}, gripper.max_turn, "turned")
    require({"theta_z": 1.0}, gripper.max_turn, "turned")
    # Without obstacles there is no such condition.
    if np.isfinite(clearance):
        for axis in ("tau_x", "tau_y", "tau_z"):
            require({axis: 1.0}, clearance, "collision")
    matrix, bounds, names = zip(*rows, strict=True)
    return Conditions(np.array(matrix), np.array(bounds, dtype=float), tuple(names))


_COLUMNS = {"eta_x": 0, "eta_y": 1, "eta_z": 2, "theta_y": 4, "theta_z": 5} | {
    "tau_x": 6,
    "tau_y": 7,
    "tau_z": 8,
}
"""Column of each error in `Conditions`; theta is the rotation of eta."""


def success_probability(
    conditions: Conditions, covariance: Float[np.ndarray, "12 12"]
) -> tuple[float, dict[str, float]]:
    """Return the probability that all conditions hold, and that each kind fails by itself.

    Args:
        conditions: from `grasp_conditions`.
        covariance: of the errors, which have mean zero.
    """
    eigenvalues, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(eigenvalues.clip(0.0))
    # Only directions with a variance need a dimension of the sequence.
    used = eigenvalues > 1e-14 * max(float(eigenvalues[-1]), 1e-300)
    errors = _normal_draws(len(covariance))[:, : int(used.sum())] @ root[:, used].T
    failed = errors @ conditions.matrix.T > conditions.bounds
    by_name = {
        name: float(failed[:, [n == name for n in conditions.names]].any(axis=1).mean())
        for name in dict.fromkeys(conditions.names)
    }
    return float(1.0 - failed.any(axis=1).mean()), by_name


@cache
def _normal_draws(dimension: int) -> Float[np.ndarray, "draws dimension"]:
    """Return points that fill a standard normal distribution evenly, always the same ones."""
    # Imported here: it takes longer than the rest of SciPy, and few commands need it.
    from scipy.stats import qmc

    sobol = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng(0))
    # Never exactly 0 or 1, where the normal distribution's quantile is infinite.
    return ndtri(sobol.random_base2(LOG2_DRAWS).clip(1e-12, 1.0 - 1e-12))
