"""Fit all parameters of the chain to every observation in one nonlinear least squares problem."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool

from ..argument_checks import require_instance, require_one_of
from ..calibration import Calibration
from ..cameras import AbstractLens
from ..dataset import Dataset, PoseDataset, chain_residuals, digests_to_keep, repeated_views
from ..engine import AbstractLoss, Noise, ParameterChoice, Prior, with_lens
from ..fit_result import Rejection
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.compilation import refuse_traced
from ..runtime.modules import with_fields
from ..staged import with_region
from .consistent_views import fit_consistent_views
from .gross_errors import remove_gross_errors, without_views
from .held_parameters import held_value_test
from .joint_fit import JointFit
from .plausibility import plausibility_warnings
from .refit import HeldValueTest
from .undetermined import require_moving_robot
from .view_fit import FitOptions

GROSS_ERRORS_OPTIONS = ("auto", "keep", "leave_out")
"""The accepted values of `gross_errors`."""


class CameraOptions(TypedDict, total=False):
    """The options of `fit_joint` that also a camera alone has, as its keyword arguments."""

    loss: str | AbstractLoss | None
    fixed: Sequence[str]
    priors: Mapping[str, Prior] | None
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None


class JointOptions(CameraOptions, total=False):
    """The options of `fit_joint` that concern the fit itself, as its keyword arguments."""

    noise: str | Noise
    field: FieldChoice
    free: Sequence[str]
    devices: Sequence[Any] | None
    gross_errors: str
    robot_prior: RobotPrior | None


@on_one_blas_thread
def fit_joint(
    data: Dataset,
    start: Calibration,
    *,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "estimated",
    field: FieldChoice = "auto",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None = None,
    devices: Sequence[Any] | None = None,
    gross_errors: str = "auto",
    inliers: Bool[Array, "views points"] | Bool[np.ndarray, "views points"] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> JointFit:
    """Fit camera, hand-eye transform, target pose and optional parameters to all pixels at once.

    Args:
        data: at least three views with four visible points each, unless priors determine the rest.
        start: a calibration near the solution, such as the staged fit's.
        lens: a lens model that differs from the start's.
        noise: `"estimated"` estimates the variance components, and chooses a robot error field, by
            restricted likelihood; a `Noise` states the standard deviations and gives every view a
            pose correction with a prior; `"trusted"` takes the reported poses as exact.
        field: the robot error field: one of `robot_errors`, or a custom one; None for none.
            `"auto"` averages over models by likelihood if the noise is estimated, and otherwise
            keeps the start's field fixed.
        loss: robust loss on the points: a name or an `AbstractLoss`. Its scale, and the weight of
            priors, are relative to the pixel sigma: the noise model's or, with a trusted robot,
            estimated from the residuals.
        fixed: paths of parameters that keep the start's value.
        free: paths to free that are held by default: `"target_scale"`.
        priors: a `Prior` by path; `camera.pixel_aspect` is the ratio of the focal lengths, one for
            square pixels.
        solver: any optimistix least-squares solver; by default `StructuredLM`.
        devices: devices over which the views are distributed, such as `jax.devices()`, also of
            other processes; by default the fit runs on one.
        gross_errors: `"leave_out"` leaves out gross outliers and views whose pose contradicts the
            others, and lists them in `rejected`; `"keep"` uses all data; `"auto"` leaves out if
            the noise is estimated.
        inliers: mask of the visible observations to fit, such as the inliers of an earlier step; by
            default all. Residuals are reported for all observations.
        progress: called with a line of text for each stage.
        robot_prior: prior on the standard deviations of the robot's errors, for estimated noise; by
            default for good industrial arms.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: an unknown path or name, too few views, or a start at which no point of a view
            can be projected.

    For example:

        >>> joint = sv.fit_joint(data, truth, noise=noise, fixed=("camera",))
        >>> print(joint.result.message, len(joint.parameter_names))
        converged in 3 steps 12
    """
    require_one_of("gross_errors", gross_errors, GROSS_ERRORS_OPTIONS)
    refuse_traced("fit_joint", data, start)
    require_instance("data", data, Dataset)
    if isinstance(data, PoseDataset) and "camera" not in fixed:
        raise TypeError("data: tracked poses are fitted by fit_poses; found a PoseDataset")
    require_instance("start", start, Calibration, "a fit has its calibration as `.calibration`")
    if solver is not None:
        hint = "such as optimistix.LevenbergMarquardt(rtol, atol)"
        require_instance("solver", solver, optx.AbstractLeastSquaresSolver, hint)
    field, all_data = checked_field_choice(field), data
    choice = ParameterChoice.of(fixed, free, priors)
    if start.base_from_other_base is not None:
        data = data.with_bases(start.base_from_other_base)
    if inliers is not None:
        data = data.with_visible(np.asarray(data.visible) & np.asarray(inliers))
    require_moving_robot(data, start, choice)
    keeps_all = gross_errors == "keep" or (gross_errors == "auto" and noise != "estimated")
    # The engine works with true points; the shape is estimated with the noise.
    stated_shape = None if noise == "estimated" else start.target_shape
    start = with_fields(with_lens(start, lens), target_shape=None)
    rejected_points: tuple[Rejection, ...] = ()
    if not isinstance(data, PoseDataset):
        data = without_views(data, repeated_views(data))
        if not keeps_all:
            data, rejected_points = remove_gross_errors(data, start, fixed, priors, progress)
    options = FitOptions(
        start,
        choice,
        noise,
        field,
        loss=loss,
        solver=solver,
        devices=devices,
        target_shape=stated_shape,
        rejected_points=rejected_points,
        progress=progress or (lambda _: None),
    )
    fit, judged, used_data = fit_consistent_views(data, options, robot_prior, keeps_all)
    stated = None if isinstance(data, PoseDataset) else held_value_test(judged)
    return _finish_fit(fit, used_data, all_data, stated)


def _finish_fit(
    fit: JointFit, used_data: Dataset, all_data: Dataset, stated: HeldValueTest | None
) -> JointFit:
    """Return the fit with the residuals of all data, its region of viewpoints and its warnings."""
    # Residuals include rejected observations. The region is added after they are computed, because
    # it changes the structure of the calibration, and so would need a new program.
    residuals = to_device(chain_residuals(fit.calibration, all_data.observations))
    calibration = with_region(fit.calibration, used_data)
    digests = () if isinstance(all_data, PoseDataset) else digests_to_keep(all_data)
    fit = with_fields(fit, residuals=residuals, calibration=calibration, picture_digests=digests)
    if stated is None or not stated.warnings:
        return with_fields(fit, warnings=plausibility_warnings(fit))
    # The warnings judge what the views tell: more views do not narrow what wrong values widen.
    warnings = plausibility_warnings(fit, stated.warnings)
    wider = stated.widened(fit.covariance, fit.std, fit.parameter_names)
    return with_fields(fit, covariance=wider[0], std=wider[1], warnings=warnings)
