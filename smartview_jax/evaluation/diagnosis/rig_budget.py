"""Divide the errors of a rig's cameras, and the uncertainty of their poses, among the causes."""

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...dataset import Rig
from ...engine import ROBOT_ERROR, FitCovariance, is_size, solve, step_names
from ...geometry import host_matrices, host_transforms
from ...joint import RigFit, RigUncertainty, fit_rig, relative_pose
from ...robot_errors import LinearInPose
from ..measures import reprojection_errors
from ..rejections import without_rejected_rig_views
from .causes import (
    PIXEL_NOISE,
    ROBOT_NOISE,
    SYSTEMATIC_ROBOT_ERROR,
    ErrorBudget,
    has_generic_arm,
    ranked_budget,
    rms_of_causes,
)

TARGET_SIZE = "target size"
"""The name of the cause: what a prior leaves open of the target's size."""
OTHER_PRIORS = "priors"
"""The name of the cause: what other priors leave open."""
SIZES_OF_ERRORS = "sizes of the errors"
"""The name of the cause: the noise, and the model of the robot's error, are estimates."""
CONTRADICTED_VALUES = "contradicted values"
"""The name of the cause: held values that the pictures contradict."""


class PoseCause(NamedTuple):
    """The contribution of one cause to the uncertainty of a pose; squares of causes add up.

    Attributes:
        name: name of the cause.
        translation: standard deviation of the translation, all axes together, m.
        rotation: standard deviation of the rotation, all axes together, rad.
    """

    name: str
    translation: float
    rotation: float


class PoseUncertainty(NamedTuple):
    """The uncertainty of a pose, divided among its causes.

    Attributes:
        name: path of a hand-eye transform, such as `left.camera_from_tool`, or `right in left` for
            the pose of one camera in another's frame.
        translation: standard deviation of the translation, all axes together, m; infinite if
            nothing determines it along an axis.
        rotation: the same of the rotation, rad.
        causes: causes, the one with the largest effect on the translation first.
    """

    name: str
    translation: float
    rotation: float
    causes: tuple[PoseCause, ...]


class RigErrorBudget(NamedTuple):
    """The errors of a rig's cameras and the uncertainty of their poses, divided among the causes.

    Attributes:
        cameras: budget of each camera's chain without correction, by the camera's name.
        poses: the hand-eye transform of each camera, and each pair of cameras on one mount.
    """

    cameras: dict[str, ErrorBudget]
    poses: tuple[PoseUncertainty, ...]


def rig_error_budget(
    rig: Rig, fit: RigFit, progress: Callable[[str], None] | None = None
) -> RigErrorBudget:
    """Divide the errors of a rig's cameras, and the uncertainty of their poses, among the causes.

    `error_budget` calls it for a rig, and explains the arguments.

    Raises:
        ValueError: the data leave a parameter undetermined, or the rig has several arms.
    """
    rig.require_one_arm("error_budget")
    report = progress or (lambda _: None)
    used, chain = without_rejected_rig_views(rig, fit), fit
    error = next(iter(fit.calibrations.values())).robot_error
    if error is not None and has_generic_arm(error.field):
        # As for one camera: without correction, link lengths have taken from the mounts.
        report("error budget: field")
        chain = _with_linear_field(used, fit)
    states, budgets = len(used.usable_views()), {}
    for name, data in used.cameras.items():
        estimate = chain.estimate(name)
        budgets[name] = ranked_budget(
            reprojection_errors(estimate.calibration.uncorrected, data).rms,
            rms_of_causes(estimate, data, np.asarray(fit.inliers[name])),
            chain.noise,
            states,
            uses_fitted_chain=chain is fit,
        )
    return RigErrorBudget(budgets, pose_uncertainties(fit))


def _with_linear_field(used: Rig, fit: RigFit) -> RigFit:
    """Return the rig's fit with a field linear in the pose."""
    starts = {name: calibration.uncorrected for name, calibration in fit.calibrations.items()}
    poses = host_matrices(used.base_from_tool)[used.usable_views()]
    cameras = {f"{name}.camera" for name in fit.calibrations}
    mounts = {f"{name}.{c.transform_names[0]}" for name, c in fit.calibrations.items()}
    held = [
        path
        for path in cameras | mounts
        if not any(name.startswith(f"{path}.") for name in fit.parameter_names)
    ]
    field = LinearInPose.from_poses(host_transforms(poses))
    return fit_rig(used, starts, field=field, fixed=held)


def pose_uncertainties(fit: RigFit) -> tuple[PoseUncertainty, ...]:
    """Return the uncertainty of each hand-eye transform and each relative pose, by cause."""
    by_cause = covariance_by_cause(fit)
    calibrations, names = fit.calibrations, fit.parameter_names
    place, poses = {name: k for k, name in enumerate(names)}, []
    for name, calibration in calibrations.items():
        path = f"{name}.{calibration.transform_names[0]}"
        # A parameter that was held has the variance that is appended.
        rows = [place.get(step_name, -1) for step_name in step_names(path)]
        variances = {
            cause: np.append(np.diagonal(matrix), 0.0)[rows] for cause, matrix in by_cause.items()
        }
        is_open = np.isinf([fit.std.get(step_name, 0.0) for step_name in step_names(path)])
        poses.append(_pose_uncertainty(path, variances, is_open))
    for first, second in combinations(calibrations, 2):
        if fit.on_one_mount(first, second):
            covariances = {
                cause: relative_pose(
                    calibrations, RigUncertainty(names, matrix), first, second
                ).covariance
                for cause, matrix in by_cause.items()
            }
            variances = {cause: np.diagonal(matrix) for cause, matrix in covariances.items()}
            is_open = np.isinf(fit.relative(first, second).std)
            poses.append(_pose_uncertainty(f"{second} in {first}", variances, is_open))
    return tuple(poses)


def covariance_by_cause(fit: RigFit) -> dict[str, Float[np.ndarray, "free free"]]:
    """Divide the covariance of a rig's common parameters among its causes; their sum is all of it.

    The estimate is a linear function of independent errors: of the pixels, of the states' reported
    poses, and of the parameters that have priors. Each of these has its part of the covariance.
    """
    problem, names = fit.built.problem, fit.parameter_names
    # The program of the fit gives the equations at its solution, so that nothing is compiled.
    _, equations = solve(problem, start=fit.solution.z)
    # As in the fit, before what estimated sizes of the errors add.
    uncertainty = FitCovariance.of(equations.matrix)
    gain, known = uncertainty.reduced.gain, uncertainty.shared
    # The estimate's error is P (J^T e)_shared - P sum_s K_s^T (J^T e)_s, with K_s the gain of a
    # state's own parameters. A prior's whitened error has the covariance 1:
    #     of shared parameters P W^2 P, with W its weights; of states P sum_s K_s^T W_s^2 K_s P.
    weight = problem.host_prior_weight
    noise_std = np.where(problem.per_view_free, np.asarray(problem.prior_weight.per_view), 0.0)
    is_field = np.array([ROBOT_ERROR in name.split(".") for name in names], dtype=bool)
    of_size = np.array([is_size(name) for name in names], dtype=bool)
    precisions = {
        ROBOT_NOISE: np.einsum("ski,sk,skj->ij", gain, noise_std**2, gain),
        SYSTEMATIC_ROBOT_ERROR: np.diag(np.where(is_field, weight, 0.0) ** 2),
        TARGET_SIZE: np.diag(np.where(of_size, weight, 0.0) ** 2),
        OTHER_PRIORS: np.diag(np.where(is_field | of_size, 0.0, weight) ** 2),
    }
    parts = {cause: known @ inner @ known for cause, inner in precisions.items()}
    # The pixels' part is what remains of P, as P is the inverse of the sum of all precisions.
    parts[PIXEL_NOISE] = known - np.sum(list(parts.values()), axis=0)
    by_fitted = problem.host_named_by_fitted(fit.solution.z)
    if by_fitted is not None:
        known = by_fitted @ known @ by_fitted.T
        parts = {cause: by_fitted @ part @ by_fitted.T for cause, part in parts.items()}
    if fit.contradicted_covariance is not None:
        known = known + fit.contradicted_covariance
        parts[CONTRADICTED_VALUES] = fit.contradicted_covariance
    if fit.noise_estimates:
        parts[SIZES_OF_ERRORS] = np.asarray(fit.covariance) - known
    return {cause: part for cause, part in parts.items() if part.any()}


def _pose_uncertainty(
    name: str,
    variances: Mapping[str, Float[np.ndarray, "6"]],
    is_open: Bool[np.ndarray, "6"],
) -> PoseUncertainty:
    """Return the uncertainty of a pose from the variances of its parameters due to each cause.

    Args:
        name: of the pose.
        variances: variance of each of its parameters, by cause.
        is_open: whether nothing determines the parameter.
    """
    # Of translation and rotation, all axes together.
    sums = {cause: variance.reshape(2, 3).sum(axis=1) for cause, variance in variances.items()}
    # Rounding may make the part of a cause without effect slightly negative.
    causes = [
        PoseCause(cause, *np.sqrt(variance.clip(0.0)).tolist()) for cause, variance in sums.items()
    ]
    causes.sort(key=lambda cause: -cause.translation)
    stds = np.sqrt(np.sum(list(sums.values()), axis=0))
    places, turns = np.where(is_open.reshape(2, 3).any(axis=1), np.inf, stds)
    return PoseUncertainty(name, float(places), float(turns), tuple(causes))
