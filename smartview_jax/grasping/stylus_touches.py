"""Compare where a stylus touched with where it was supposed to touch, on a real robot (Fig. 2).

The calibration predicts how far the tip may miss: by the errors of the target's pose in the base,
of the robot's correction, and by the robot's own noise. Much larger misses reveal an error that is
invisible in the pixels. `evaluation.stylus_error` is the same test with known true values.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..geometry import host_cross_matrices, host_rotations_between
from .tool_commands import ToolCommands

ELLIPSE_PROBABILITY = 0.95
"""Probability with which a miss is inside its error ellipse."""

ELLIPSE_RADII = {2: 2.4477468306808161, 3: 2.7954834829151074}
"""Radius of the ellipse in standard deviations, by the number of components of a miss.

Its square is exceeded by chi-square with the probability 0.05. SciPy, which knows it for any
probability, takes longer to import than everything else here.
"""

MIN_TIP_DISTANCE = 1e-6
"""Distance of the tip from the tool's origin, m, below which the stylus is the tool's z axis."""


class MissComparison(NamedTuple):
    """Measured misses compared with the expected ones, for each touch and for all together.

    Attributes:
        expected_rms: expected root mean square distance, m.
        inside: whether each miss is inside its error ellipse.
        chi_square: squared misses over their covariance, including errors common to all touches.
        degrees_of_freedom: number of components of all misses, which is the chi-square's mean.
        p_value: probability of a larger chi-square, if the calibration's uncertainty is true.
    """

    expected_rms: float
    inside: Bool[np.ndarray, "touches"]
    chi_square: float
    degrees_of_freedom: int
    p_value: float


def stylus_orientations(
    tip: Float[np.ndarray, "3"], world_from_stylus: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """Return `world_from_tool` rotations for a stylus along the line from the tool to its tip.

    Args:
        tip: position of the tip in the tool's frame, m; at the origin the stylus is the z axis.
        world_from_stylus: rotations whose z axis is the direction in which the stylus points.
    """
    axis = np.array([0.0, 0.0, 1.0]) if np.linalg.norm(tip) < MIN_TIP_DISTANCE else tip
    # The smallest rotation that takes z to the stylus's direction in the tool.
    z = np.array([[0.0, 0.0, 1.0]])
    tool_from_stylus = host_rotations_between(z, axis[None] / np.linalg.norm(axis))
    return world_from_stylus @ tool_from_stylus.swapaxes(1, 2)


def tip_error_factor(
    touches: ToolCommands, tip: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3 errors"] | None:
    """Return how independent errors of unit variance move the tip, in the world's axes, m.

    The product with its own transpose is the covariance of the misses, also between touches.

    Args:
        touches: commands that bring the tip to its points.
        tip: position of the tip in the tool's frame, m.

    Returns:
        None where the calibration was taken as exact.
    """
    if touches.error_factor is None:
        return None
    # exp(tau) tool_from_world, so that the tip is displaced in the world by
    #     -R (tau_t + tau_r x tip),   R = world_from_tool.
    by_tau = np.concatenate([np.eye(3), -host_cross_matrices(tip)], axis=1)
    return -touches.world_from_tool[:, :3, :3] @ by_tau @ touches.error_factor


def measured_error_factor(
    touches: ToolCommands,
    tip: Float[np.ndarray, "3"],
    measurement_std: float,
    tip_std: float = 0.0,
) -> Float[np.ndarray, "n 3 errors"] | None:
    """Return the factor of `tip_error_factor` for misses as they are measured.

    Args:
        touches: commands that bring the tip to its points.
        tip: position of the tip in the tool's frame, m.
        measurement_std: standard deviation of each measured component, m.
        tip_std: standard deviation of each component of `tip`, m; common to all touches.

    Returns:
        None where the calibration was taken as exact.
    """
    factor = tip_error_factor(touches, tip)
    if factor is None:
        return None
    count = len(factor)
    # The tip's own error is turned with the tool; each touch is measured with an error of its own.
    by_tip = tip_std * touches.world_from_tool[:, :3, :3]
    by_measuring = measurement_std * np.eye(3 * count).reshape(count, 3, 3 * count)
    return np.concatenate([factor, by_tip, by_measuring], axis=2)


def ellipse_axes(
    covariance: Float[np.ndarray, "d d"],
) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d d"]]:
    """Return half axes, longest first, and their directions as columns, of an error ellipse."""
    eigenvalues, vectors = np.linalg.eigh(covariance)
    return ELLIPSE_RADII[len(covariance)] * np.sqrt(eigenvalues[::-1].clip(0.0)), vectors[:, ::-1]


def compare_misses(
    error_factor: Float[np.ndarray, "n 3 errors"], misses: Float[np.ndarray, "touches d"]
) -> MissComparison:
    """Compare measured misses with the errors that the calibration expects.

    Args:
        error_factor: of the touches, as `measured_error_factor` returns it; as `tip_error_factor`
            does, for misses that are measured without an error.
        misses: measured tip minus point, in the world's axes, m: x and y, or x, y and z.

    Raises:
        ValueError: numbers of touches that differ, or misses that have neither two nor three
            components.
    """
    # Only where somebody measured: the commands alone are printed in less time.
    from scipy.special import chdtrc

    count, size = misses.shape
    if count != len(error_factor) or size not in (2, 3):
        raise ValueError(
            f"misses: expected 2 or 3 numbers for each of {len(error_factor)} touches, "
            f"found shape {misses.shape}"
        )
    factor = error_factor[:, :size]
    covariances = factor @ factor.swapaxes(1, 2)
    single = np.array([_chi_square(c, m) for c, m in zip(covariances, misses, strict=True)])
    # Most of the error is common to all touches: together they are less informative than
    # independent ones.
    stacked = factor.reshape(count * size, -1)
    chi_square = _chi_square(stacked @ stacked.T, misses.ravel())
    return MissComparison(
        float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean())),
        single <= ELLIPSE_RADII[size] ** 2,
        chi_square,
        count * size,
        float(chdtrc(count * size, chi_square)),
    )


def _chi_square(covariance: Float[np.ndarray, "n n"], values: Float[np.ndarray, "n"]) -> float:
    """Return the squared Mahalanobis length; infinite for a value without an allowed error."""
    scale = np.trace(covariance) / len(covariance)
    eigenvalues, vectors = np.linalg.eigh(covariance)
    squares = (vectors.T @ values) ** 2
    possible = eigenvalues > 1e-12 * scale
    # A zero up to rounding counts as zero.
    if (squares[~possible] > 1e-12 * max(scale, 1e-300)).any():
        return float("inf")
    return float(np.sum(squares[possible] / eigenvalues[possible]))
