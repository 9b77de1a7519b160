"""Say that the arm bends, and by how much: its errors then depend on how far it reaches."""

import numpy as np
from jaxtyping import Float

from ..engine import ROBOT_ERROR
from ..geometry import host_matrices
from ..robot_errors import (
    CombinedField,
    QuadraticInPosition,
    SmoothInPose,
    squares_and_products,
)
from ..variance import MIN_SHAPE_SIGMAS
from .joint_fit import JointFit
from .parameter_estimates import whole_error_stds

MIN_BENDING_PROBABILITY = 0.5
"""Probability of the models with errors that are quadratic in the position, above which the bending
of an arm of unknown geometry is named, if it is significant."""


def bending_warnings(fit: JointFit) -> list[str]:
    """Return sentences on joints that bend under the arm's weight, or on curved errors of poses.

    Both are corrected where the calibration is used with its correction.
    """
    if fit.noise_estimate is None or fit.calibration.robot_error is None:
        return []
    return _bending_joints(fit) + _curved_errors(fit)


def _bending_joints(fit: JointFit) -> list[str]:
    """Return a sentence on the joints whose compliance is significant."""
    compliances = _coefficients(fit, "joint_compliance")
    known = {**fit.std, **whole_error_stds(fit)}
    stds = {name: known[f"{ROBOT_ERROR}.{name}"] for name in compliances}
    named = [
        f"{name.split('.')[1]} by {np.rad2deg(abs(value)):.3f} +- {np.rad2deg(stds[name]):.3f}"
        for name, value in compliances.items()
        if abs(value) > MIN_SHAPE_SIGMAS * stds[name]
    ]
    if not named:
        return []
    return [
        f"the arm bends: joint {', '.join(named)} degrees under a torque as large as the arm's own "
        "weight exerts at its base when it is stretched out; this is corrected"
    ]


def _curved_errors(fit: JointFit) -> list[str]:
    """Return a sentence on errors quadratic in the position, if probable and significant."""
    assert fit.noise_estimate is not None
    probability = sum(
        candidate.probability
        for candidate in fit.noise_estimate.candidates
        if candidate.model.field.endswith("_squared")
    )
    curved = _coefficients(fit, "translation_by_square")
    if not curved or probability < MIN_BENDING_PROBABILITY:
        return []
    rows = [fit.parameter_names.index(f"{ROBOT_ERROR}.{name}") for name in curved]
    covariance = np.asarray(fit.covariance)[np.ix_(rows, rows)]
    by_coefficient = _curvature(fit).reshape(-1, len(curved))
    values = np.array(list(curved.values()))
    count = len(by_coefficient) / 3.0
    moments = by_coefficient.T @ by_coefficient / count
    # rms = sqrt(c^T M c) of the coefficients c, with the gradient M c / rms.
    rms = float(np.sqrt(values @ moments @ values))
    gradient = moments @ values / max(rms, np.finfo(float).tiny)
    std = float(np.sqrt(gradient @ covariance @ gradient))
    if not rms > MIN_SHAPE_SIGMAS * std:
        return []
    return [
        f"the robot's error is curved, as of an arm that bends under its weight: over the views "
        f"{1e3 * rms:.2f} +- {1e3 * std:.2f} mm RMS from a straight line; this is corrected"
    ]


def _coefficients(fit: JointFit, group: str) -> dict[str, float]:
    """Return the fitted coefficients of a group of the robot error by name."""
    error = fit.calibration.robot_error
    assert error is not None
    error = error.whole
    values = zip(error.field.names, np.asarray(error.coefficients), strict=True)
    return {
        name: float(value)
        for name, value in values
        if name.startswith(f"{group}.") and f"{ROBOT_ERROR}.{name}" in fit.parameter_names
    }


def _curvature(fit: JointFit) -> Float[np.ndarray, "views 3 coefficients"]:
    """Return the part of the translation that is not linear in the position, per coefficient, m."""
    field = fit.calibration.field
    smooth = field.first if isinstance(field, CombinedField) else field
    assert isinstance(smooth, QuadraticInPosition | SmoothInPose)
    poses = host_matrices(fit.problem.observations.base_from_tool)[fit.used_views]
    offset = (poses[:, :3, 3] - np.asarray(smooth.centre)) / float(smooth.reach)
    products = np.asarray(squares_and_products(offset))
    linear = np.column_stack([np.ones(len(offset)), offset])
    rest = products - linear @ np.linalg.lstsq(linear, products, rcond=None)[0]
    # A coefficient is of one product, along one axis of the base.
    return np.einsum("vf,ij->vifj", rest, np.eye(3)).reshape(len(rest), 3, -1)
