"""Correct a calibration by touches of a stylus: the paper's test (Fig. 2) as a measurement.

Most of a miss is common to all touches: the target's pose in the base and the robot's error are
known no better than the pictures tell. The misses of a few touches measure them directly.
"""

import dataclasses
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..engine import Parameters, Step, parameter_names
from ..joint import SavedEstimate
from ..runtime.array_namespace import to_device
from ..runtime.compilation import one_program
from .contradicted_touches import causes_of_misses
from .stylus_touches import compare_misses, measured_error_factor
from .tool_commands import ToolCommands

if TYPE_CHECKING:
    from ..joint import JointFit

MIN_CHANCE = 1e-6
"""Probability of larger misses by chance below which they are refused."""


def correct_by_touches(
    estimate: "JointFit | SavedEstimate",
    touches: ToolCommands,
    tip: Float[np.ndarray, "3"],
    misses: Float[np.ndarray, "touches d"],
    *,
    measurement_std: float,
    tip_std: float = 0.0,
) -> SavedEstimate:
    """Return the calibration and its covariance after a stylus has touched some points.

    The result is, to first order, the joint fit of the pictures and the touches: the fit's
    covariance is the prior, the misses are the data. The robot's own noise in each touch counts as
    noise. Points in several places also determine the target's orientation.

    Args:
        estimate: fit of a camera on the hand, with its covariance.
        touches: commands that bring the tip to its points, made with this `estimate`.
        tip: position of the tip in the tool's frame, m.
        misses: measured tip minus point, in the world's axes, m: x and y, or x, y and z.
        measurement_std: standard deviation of each measured component, m.
        tip_std: standard deviation of each component of `tip`, m; common to all touches.

    Raises:
        ValueError: commands without the calibration's errors, numbers of touches that differ,
            misses that have neither two nor three components or are not finite, a
            `measurement_std` that is not positive, or misses that are larger than all this allows.

    For example:

        >>> world_from_tool = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (2, 1, 1))
        >>> world_from_tool[:, :3, 3] = [[0.0, 0.0, 0.15], [0.1, 0.0, 0.15]]
        >>> touches = sv.tool_commands(fit.calibration, world_from_tool, estimate=fit.joint)
        >>> misses = np.array([[2e-4, 0.0, -1e-4], [2e-4, 1e-4, -1e-4]])
        >>> tip = np.array([0.0, 0.0, 0.15])
        >>> corrected = sv.correct_by_touches(
        ...     fit.joint, touches, tip, misses, measurement_std=5e-5
        ... )
    """
    factor = measured_error_factor(touches, tip, measurement_std, tip_std)
    if factor is None or touches.parameter_factor is None:
        raise ValueError(
            "touches: the calibration was taken as exact; make them by tool_commands(..., "
            "estimate=...)"
        )
    count, size = misses.shape
    if count != len(factor) or size not in (2, 3) or not np.isfinite(misses).all():
        raise ValueError(
            f"misses: expected 2 or 3 finite numbers for each of {len(factor)} touches, found "
            f"{misses.tolist() if misses.size < 10 else misses.shape}"
        )
    if not (measurement_std > 0.0 and tip_std >= 0.0):
        raise ValueError(
            "expected a positive measurement_std and a tip_std of at least 0, found "
            f"{measurement_std} and {tip_std}"
        )
    if compare_misses(factor, misses).p_value < MIN_CHANCE:
        raise ValueError(
            "misses: larger than the calibration, the tip and the measurement allow: "
            f"{causes_of_misses(factor, misses)}"
        )
    # Without the last part, the errors of measuring, which are sigma in each component.
    by_errors = factor[:, :size, : -3 * count].reshape(count * size, -1)
    # With independent errors e of unit variance and misses m = F e + noise, the errors' mean is
    # F^T S^-1 m and their covariance I - F^T S^-1 F, with S = F F^T + sigma^2 I.
    S = by_errors @ by_errors.T + measurement_std**2 * np.eye(count * size)
    gain = np.linalg.solve(S, by_errors).T
    to_parameters = touches.parameter_factor
    known = to_parameters.shape[1]
    start, names = estimate.calibration, parameter_names(estimate.calibration)
    step = np.zeros(len(names))
    rows = [names.index(name) for name in touches.parameter_names]
    step[rows] = to_parameters @ (gain @ misses.ravel())[:known]
    # Parameters that were not estimated stay exact.
    covariance = np.zeros((len(names), len(names)))
    remaining = np.eye(known) - (gain @ by_errors)[:known, :known]
    covariance[np.ix_(rows, rows)] = to_parameters @ remaining @ to_parameters.T
    kept = [names.index(name) for name in estimate.parameter_names]
    covariance = covariance[np.ix_(kept, kept)]
    saved = estimate if isinstance(estimate, SavedEstimate) else SavedEstimate.of(estimate)
    calibration = dataclasses.replace(
        _stepped(start, to_device(step)), region=start.region, target_shape=start.target_shape
    )
    return saved._replace(
        calibration=calibration,
        covariance=0.5 * (covariance + covariance.T),
    )


@one_program
def _stepped(calibration: Calibration, step: Float[Array, "parameters"]) -> Calibration:
    """Return the calibration after a step of its parameters."""
    return Parameters(calibration).retract(Step(step, jnp.zeros((0, 6))))[0]
