"""Define the result of a joint fit: estimates, their covariance, and the underlying problem."""

import os
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import ndtri, stdtrit

from ..calibration import Calibration
from ..dataset import DepthSensor
from ..engine import (
    JointProblem,
    Noise,
    Observability,
    Parameters,
    Solution,
    parameter_mask,
    parameter_names,
    refuse_aspects,
)
from ..fit_result import FitResult, Rejection
from ..runtime.compilation import is_traced
from ..runtime.modules import HostModule, with_fields
from ..variance import NoiseEstimate, p_value
from .fit_text import fit_html, fit_line, fit_text, noise_text, points_and_residual
from .influence import Influence, deletion_changes
from .saved_estimate import SavedEstimate


class JointFit(HostModule):
    """The result of a joint fit.

    Attributes:
        calibration: camera, hand-eye transform, target pose (and target scale, if free).
        covariance: covariance of the free parameters that all views have in common, in the order of
        `parameter_names`, in their own units.
        std: standard deviation by name, also of pose corrections; infinite for undetermined
        parameters.
        degrees_of_freedom: degrees of freedom of each common parameter's standard deviation, by
        name; infinite if the variance components were not estimated.
        noise: the noise model, given or estimated; None with `noise="trusted"`. For an exact robot
        the estimated standard deviations of its errors are close to zero.
        noise_estimate: the estimate of the noise model and its candidates; None if it was not
        estimated.
        pixel_sigma: standard deviation of u and of v, px: as given, or from the residuals and their
            degrees of freedom.
        residuals: measured minus predicted through the chain *without* pose corrections, px.
        inliers: observations within the chi-square gate around the fit; the others were used too.
        rejected: observations left out: view id, point index (None for a whole view), reason.
        pose_corrections: one twist per view, translation (m) then rotation (rad), at the tool; of
            two arms, about the point midway between their hands.
        field_corrections: one twist per view at the tool, from the reported pose to the pose
            corrected by the robot error field; zero without a field.
        observability: the directions that the data do not determine.
        parameter_names: names of the free parameters that all views have in common.
        view_ids: names of the data's views.
        start: the calibration from which the fit started; with estimated noise, the final
            calibration of this estimation.
        problem: the least squares problem that was solved.
        solution: the final step, with iterations and costs.
        result: whether the fit converged.
        warnings: reasons to doubt the result, a sentence each.
        pose_format: format in which the robot's controller writes poses; None if it is not known.
        sensor: the depth sensor, whose bias is in `covariance`: of depths at the points in pictures
            it is among the parameters; of measured points scale and offset were held, but their
            uncertainty was added. None for pictures alone and other trackers.
        picture_digests: digests of the pictures, by which `smartview evaluate` recognises them.

    For example:

        >>> joint = fit.joint
        >>> x = joint.calibration.camera_from_tool.translation()[0]
        >>> half_width = joint.confidence_half_width("camera_from_tool.translation.x")
        >>> print(f"x = {1e3 * x:.1f} +- {1e3 * half_width:.1f} mm", joint.result.converged)
        x = -19.1 +- 1.1 mm True
    """

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]
    pixel_sigma: float = eqx.field(static=True)
    residuals: Float[Array, "views points 2"]
    inliers: Bool[Array, "views points"]
    pose_corrections: Float[Array, "views 6"]
    field_corrections: Float[Array, "views 6"]
    start: Calibration
    problem: JointProblem
    solution: Solution
    std: dict[str, float]
    degrees_of_freedom: dict[str, float]
    noise: Noise | None = eqx.field(static=True)
    noise_estimate: NoiseEstimate | None
    rejected: tuple[Rejection, ...] = eqx.field(static=True)
    observability: Observability = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    view_ids: tuple[str, ...] = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)
    warnings: tuple[str, ...] = eqx.field(static=True, default=())
    pose_format: str | None = eqx.field(static=True, default=None)
    sensor: DepthSensor | None = eqx.field(static=True, default=None)
    picture_digests: tuple[str, ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        # A traced fit, inside `jit`, has no figures to show.
        if is_traced(self):
            return super().__repr__()
        return f"<{fit_line(self)}>"

    def __str__(self) -> str:
        if is_traced(self):
            return super().__repr__()
        return fit_text(self, self.warnings)

    def _repr_html_(self) -> str:
        return fit_html(self, self.warnings)

    @property
    def used_views(self) -> Bool[np.ndarray, "views"]:
        """Mask of the views with an observation that agrees with the fit."""
        return np.asarray(np.asarray(self.inliers).any(axis=1))

    @property
    def fits_camera(self) -> bool:
        """Whether the camera is fitted and shown."""
        return True

    @property
    def described(self) -> str:
        """The number of points and their residual, in words."""
        return points_and_residual(self)

    @property
    def described_noise(self) -> str:
        """The standard deviations of pixels and reported poses in words."""
        return noise_text(self)

    def save(
        self,
        path: str | os.PathLike[str],
        run: str | None = None,
        source: str | None = None,
        warnings: Sequence[str] | None = None,
    ) -> None:
        """Write the calibration with its covariance, noise and warnings, as YAML or JSON.

        The digests of the pictures are written too.

        `Calibration.load` reads the calibration back, `load_estimate` the covariance too. If a
        parameter is undetermined, the file has no covariance.

        Args:
            path: path of the file; JSON if it ends in `.json`.
            run: name of the run, written to all its files.
            source: origin of the calibration, such as the data set's name.
            warnings: reasons to doubt the result, a sentence each; by default the fit's.
        """
        doubts = self.warnings if warnings is None else warnings
        SavedEstimate.of(self).save(path, run, source, doubts, self.picture_digests)

    def confidence_half_width(self, name: str, level: float = 0.95) -> float:
        """Return the half width of a parameter's confidence interval, in its own unit.

        Args:
            name: as in `parameter_names`.
            level: probability that the interval contains the true value, by Student's t with the
                parameter's `degrees_of_freedom`.
        """
        return half_width(self.std[name], self.degrees_of_freedom[name], level)

    def p_value(self, truth: Calibration, paths: Sequence[str] | None = None) -> float:
        """Return the p-value of the hypothesis that some parameters have the values in `truth`.

        It is the probability of a fit at least this far from `truth` if `truth` were true. A small
        value, say below 0.05, means that the pictures contradict `truth`, for instance a mount from
        a drawing, or measured before a collision.

        Args:
            truth: a calibration with the same lens, mount and field; only the named parameters are
                compared.
            paths: paths of fitted parameters, tested jointly; by default the hand-eye transform.

        Raises:
            ValueError: calibrations with different parameters, a path that is unknown or was not
                fitted, or undetermined parameters.
        """
        paths = self.calibration.transform_names[:1] if paths is None else paths
        refuse_aspects(paths)
        indices = np.flatnonzero(parameter_mask(self.parameter_names, paths))
        names = [self.parameter_names[k] for k in indices]
        undetermined = [name for name in names if not np.isfinite(self.std[name])]
        if undetermined:
            raise ValueError(
                f"the data do not determine {', '.join(undetermined)}: see `observability`"
            )
        fit_names, truth_names = (parameter_names(c) for c in (self.calibration, truth))
        if fit_names != truth_names:
            raise ValueError(
                f"truth: expected the parameters {', '.join(fit_names)} of the fit, found "
                f"{', '.join(truth_names)}"
            )
        # d^T P^-1 d for the difference d with covariance P: chi-square if the variance components
        # are known, otherwise F with the Kenward-Roger correction.
        difference = np.asarray(Parameters(truth).step_to(self.calibration))
        return p_value(
            difference[[fit_names.index(name) for name in names]],
            self.covariance[np.ix_(indices, indices)],
            None if self.noise_estimate is None else self.noise_estimate.correction_of(names),
        )


def half_width(std: float, degrees_of_freedom: float, level: float = 0.95) -> float:
    """Return the half width of the confidence interval for a standard deviation."""
    p = 0.5 + 0.5 * level
    return std * float(
        stdtrit(degrees_of_freedom, p) if np.isfinite(degrees_of_freedom) else ndtri(p)
    )


def view_influence(fit: JointFit) -> Influence:
    """Return the influence of each view: the change of the fit without it, to first order.

    For example:

        >>> change = sv.view_influence(fit.joint).max_standardised_change()
        >>> print(f"view {data.view_ids[np.argmax(change)]}: {change.max():.1f} std")
        view 5: 1.1 std
    """
    problem, z = fit.problem, fit.solution.z
    flagged = with_fields(problem, parameters=problem.parameters.with_aspect_flag)
    changes, by_fitted = np.asarray(deletion_changes(flagged, z)), problem.host_named_by_fitted(z)
    if by_fitted is not None:
        changes = changes @ by_fitted.T
    std = np.array([fit.std[name] for name in fit.parameter_names])
    mount_path = fit.calibration.transform_names[0]
    return Influence(changes, std, fit.parameter_names, fit.view_ids, mount_path)
