"""Fit one camera to all views by an iterated extended Kalman filter (Step 2 of the paper, Eq. 9).

The state of Eq. 9, `(s, e^1 .. e^M)`, holds the camera and the pose of every view,
`n_camera + 6 M` numbers (5 + 6 M with the paper's lens). It is updated with one two-dimensional
measurement at a time: `kalman_update.py` says how that is cheap, `kalman_pass.py` runs a pass.

Step 1 gives the mean only. Its estimates come from these same pixels, so the initial covariance is
deliberately wide. Every further pass starts from that wide covariance again and keeps only the
linearisation point; otherwise the data would count twice. The fixed point of the passes is the
least-squares optimum, since one pass solves the linearised problem. A pass that raises the cost is
rejected and repeated with a narrower initial covariance, which has the effect of damping.

Outliers are rejected by a chi-square gate on the innovation, but not before the pose of their view
is determined, and relative to the noise of their view where that is larger than all views'.

References: Kosaka and Kak's model-based stereo; Bell and Cathey 1993, who show that the iterated
filter is the Gauss-Newton method.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..dataset import MAD_TO_SIGMA, Observations, medians_by_view, view_residuals
from ..geometry import host_matrices
from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.compilation import is_traced
from ..runtime.modules import HostModule
from ..runtime.padding import repeat_last, without_padding
from .kalman_pass import PassResult, PassSettings, run_pass
from .staged_fit import CommonCameraOptions

_GATING_CHANGE_THRESHOLD = 3.0
"""Change of the state, in its standard deviations, below which the outlier gate is switched on.

Earlier, all points of a view whose pose is still wrong would look like outliers."""

_MAX_RELATIVE_COST_INCREASE = 0.01
"""Fraction by which a pass may raise the cost once the gate is on.

The points rejected during a pass are not exactly those with large residuals after it."""

FAR_PIXELS = 1e4
"""Residual in u and in v of a visible point that has no projection, px."""

_MAX_PASSES = 100
"""Maximum number of passes; three to ten are usual, a hundred if Step 1 was far off."""

_MAX_GATED_PASSES = 25
"""Maximum number of passes with the gate on; the set of outliers may alternate for ever."""

_MIN_VARIANCE_SCALE = 1e-10
"""Fraction of the initial variances at which the filter stops if a pass still raises the cost."""

_MAX_VIEW_RATIO = 3.0
"""Largest standard deviation of a view, over the one of all views, by which its points are judged.

With the usual gate these are the 13 standard deviations at which the joint fit sees gross errors;
most points of a view that is farther off are wrong."""

_MEDIAN_LENGTH = np.sqrt(2.0 * np.log(2.0))
"""Median length of a vector whose two coordinates have standard deviation one (Rayleigh)."""

_SIGMA_FLOOR = 1e-3
"""Smallest pixel standard deviation, px; noise-free data would make it zero."""


class KalmanResult(HostModule):
    """The result of Step 2: the common camera, the pose of every view, and their covariance.

    Attributes:
        camera: intrinsics and lens.
        camera_from_world: one pose per view; the start pose for a view without visible points.
        inliers: the observations used.
        pixel_sigma: standard deviation of u and of v, px: as given, or estimated.
        rms: root mean square reprojection error of the inliers with these poses, px.
        passes: number of passes.
        converged: whether the last pass changed the state by less than a thousandth of its
            standard deviation.
        message: the outcome in words.
        last_pass: the last pass that was accepted; None if none was.
    """

    camera: Camera
    camera_from_world: SE3
    inliers: Bool[Array, "views points"]
    pixel_sigma: float
    rms: float
    passes: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)
    last_pass: PassResult | None

    @property
    def covariance(self) -> Float[np.ndarray, "state state"]:
        """The covariance of the camera's numbers, and of one tangent per view after them.

        A tangent (translation, rotation) acts on the pose of its view from the left. The matrix is
        put together where it is asked for, because it grows with the square of the views: of 2,000
        it has more than a gigabyte.
        """
        if self.last_pass is None:
            return np.full((0, 0), np.nan)
        # The views that padding added come last in the state.
        whole, padded_views = self.last_pass.covariance(), len(self.last_pass.pose_scale)
        size = len(whole) - 6 * (padded_views - len(self.camera_from_world.wxyz_xyz))
        return whole[:size, :size]


def kalman_filter(
    observations: Observations,
    start_camera: Camera,
    start_camera_from_world: SE3,
    start_inliers: Bool[Array | np.ndarray, "views points"] | None = None,
    options: CommonCameraOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> KalmanResult:
    """Estimate one camera and one pose per view from all observations (Eq. 9).

    Args:
        observations: points, pixels, visibility; the robot's poses are not used.
        start_camera, start_camera_from_world: the first linearisation point, from Step 1.
        start_inliers: observations not yet known to be outliers (Step 1 rejects gross errors).
            They are used until the state has settled; from then on the gate decides.
        options: noise, gate, and whether the camera is known; a pixel sigma that is not given is
            estimated before each pass.
        progress: called with a sentence about every pass.
    """
    options = options or CommonCameraOptions()
    view_count, point_count = observations.visible.shape
    observations, inliers = _padded(observations, start_inliers)
    poses = repeat_last(start_camera_from_world, len(inliers))
    state = _State(_LinearisationPoint.at(observations, start_camera, poses), inliers)
    converged, message = False, "the passes did not settle"
    passes, gated_passes = 0, 0
    for passes in range(1, _MAX_PASSES + 1):
        gated_passes += state.gating
        if gated_passes > _MAX_GATED_PASSES:
            message = "the outliers kept changing"
            break
        trial = state.pass_over(observations, options)
        if progress is not None:
            progress(
                f"pass {passes}: sigma {trial.sigma:.3f} px, changed by "
                f"{trial.result.max_change:.2g} sigma"
            )
        if not trial.lowers_cost:
            state = state.damped(trial)
            if state.variance_scale < _MIN_VARIANCE_SCALE:
                message = "the passes kept raising the cost"
                break
            continue
        before, state = state, state.after(trial, np.asarray(observations.visible))
        if before.is_settled(trial, state):
            converged, message = True, f"converged after {passes} passes"
            break
    point, inliers = state.point, state.inliers
    rms = float(np.sqrt(_mean_squared_residual(point.residuals, inliers, np.inf)))
    if not np.isfinite(rms):
        converged, message = False, "the filter diverged: its state is not finite"
    return KalmanResult(
        point.camera,
        without_padding(point.camera_from_world, view_count),
        jax.device_put(inliers[:view_count, :point_count]),
        robust_sigma(point.residuals, inliers, options.pixel_sigma),
        rms,
        passes,
        converged,
        message,
        state.accepted,
    )


class _LinearisationPoint(NamedTuple):
    """A state of the filter and the residuals there, px."""

    camera: Camera
    camera_from_world: SE3
    residuals: Float[np.ndarray, "views points 2"]

    @classmethod
    def at(
        cls, observations: Observations, camera: Camera, camera_from_world: SE3
    ) -> "_LinearisationPoint":
        """Compute the residuals of a state."""
        residuals = np.asarray(pixel_residuals(observations, camera, camera_from_world))
        return cls(camera, camera_from_world, residuals)


class _Trial(NamedTuple):
    """A pass, which is accepted if it lowers the cost.

    Attributes:
        result: the pass.
        point: the state after it.
        sigma: standard deviation of the pixels that it assumed, px.
        limits: largest squared residual of a good measurement in each view, px^2.
        lowers_cost: whether the residuals are not larger after it.
    """

    result: PassResult
    point: _LinearisationPoint
    sigma: float
    limits: Float[np.ndarray, "views"]
    lowers_cost: bool


class _State(NamedTuple):
    """The state between two passes of the filter.

    Attributes:
        point: the linearisation point.
        inliers: the observations that are used.
        gating: whether outliers are rejected, as soon as the state has settled.
        gated_limits: the limits of the last pass; None if it rejected none.
        variance_scale: factor of the initial covariance: below one the pass is damped.
        accepted: the last pass that lowered the cost; None before.
    """

    point: _LinearisationPoint
    inliers: Bool[np.ndarray, "views points"]
    gating: bool = False
    gated_limits: Float[np.ndarray, "views"] | None = None
    variance_scale: float = 1.0
    accepted: PassResult | None = None

    def pass_over(self, observations: Observations, options: CommonCameraOptions) -> _Trial:
        """Run a pass over all observations."""
        residuals, inliers = self.point.residuals, self.inliers
        sigma = robust_sigma(residuals, inliers, options.pixel_sigma)
        limits = outlier_limits(residuals, inliers, sigma, options, self.gated_limits)
        gate = limits if self.gating else np.full(len(inliers), np.inf)
        settings = PassSettings(sigma, gate / sigma**2, self.variance_scale, options.hold_camera)
        result = run_pass(observations, *self.point, inliers, settings)
        point = _LinearisationPoint.at(observations, result.camera, result.camera_from_world)
        counted = np.asarray(observations.visible) if self.gating else inliers
        before, after = (
            _mean_squared_residual(each.residuals, counted, gate[:, None])
            for each in (self.point, point)
        )
        # Rounding, and a step of a thousandth of a standard deviation, may raise the cost so much.
        allowed = (_MAX_RELATIVE_COST_INCREASE if self.gating else 0.0) * before + 1e-6 * sigma**2
        lowers_cost = bool(np.isfinite(result.max_change) and after <= before + allowed)
        return _Trial(result, point, sigma, limits, lowers_cost)

    def damped(self, trial: _Trial) -> "_State":
        """Return the state for another pass from the same point, after one that raised the cost.

        The step left the range of the linearisation: the next one starts narrower.
        """
        return self._replace(
            gated_limits=trial.limits if self.gating else None,
            variance_scale=0.1 * self.variance_scale,
        )

    def after(self, trial: _Trial, visible: Bool[np.ndarray, "views points"]) -> "_State":
        """Return the state after a pass that is accepted.

        Points with large residuals are rejected in the next pass; points that fit again are
        readmitted.
        """
        squares = np.sum(trial.point.residuals**2, axis=-1)
        within_gate = visible & (squares <= trial.limits[:, None])
        is_small = trial.result.max_change < _GATING_CHANGE_THRESHOLD
        return _State(
            trial.point,
            within_gate if self.gating else self.inliers,
            self.gating or (self._is_undamped and is_small),
            trial.limits if self.gating else None,
            min(1.0, 10.0 * self.variance_scale),
            trial.result,
        )

    def is_settled(self, trial: _Trial, after: "_State") -> bool:
        """Return whether a pass from this state to the state after it changed next to nothing."""
        return bool(
            trial.result.max_change < 1e-3
            and np.array_equal(after.inliers, self.inliers)
            and after.gating
            and self._is_undamped
        )

    @property
    def _is_undamped(self) -> bool:
        """Whether a pass is not damped.

        A damped one makes a short step anywhere, and its covariance is too small: only an undamped
        one may switch the gate on or end the iteration.
        """
        return self.variance_scale == 1.0


def _padded(
    observations: Observations, start_inliers: Bool[AnyArray, "views points"] | None
) -> tuple[Observations, Bool[np.ndarray, "padded_views padded_points"]]:
    """Return padded observations, and which of them are used at the start.

    Without visible points the views that padding adds keep their start pose.
    """
    inliers = np.asarray(observations.visible)
    if start_inliers is not None:
        inliers = inliers & np.asarray(start_inliers)
    padded = observations.padded()
    missing = np.subtract(padded.visible.shape, inliers.shape)
    return padded, np.pad(inliers, ((0, missing[0]), (0, missing[1])))


def _mean_squared_residual(
    residuals: Float[np.ndarray, "views points 2"],
    counted: Bool[np.ndarray, "views points"],
    maximum: float | Float[np.ndarray, "views 1"],
) -> float:
    """Return the mean squared reprojection error, px^2, with each square capped at a maximum.

    With the gate as the maximum, rejecting a point does not lower the mean.
    """
    squares = np.minimum(np.sum(residuals**2, axis=-1), maximum)[counted]
    return float(np.sum(squares) / max(len(squares), 1))


def pixel_residuals(
    observations: Observations, camera: Camera, camera_from_world: SE3
) -> Float[AnyArray, "views points 2"]:
    """Return measured minus projected pixels; `FAR_PIXELS` for a point without projection."""
    # The program of all fits: Step 2 has none of its own to compile.
    if is_traced(observations, camera, camera_from_world):
        residuals = view_residuals(
            camera, jnp.ones(()), camera_from_world.as_matrix(), observations
        )
        return jnp.where(jnp.isinf(residuals), FAR_PIXELS, residuals)
    poses = host_matrices(camera_from_world)
    residuals = view_residuals(camera, to_device(1.0), poses, observations)
    return np.where(np.isinf(residuals), FAR_PIXELS, residuals)


def robust_sigma(
    residuals: Float[np.ndarray, "views points 2"],
    inliers: Bool[np.ndarray, "views points"],
    pixel_sigma: float | None,
) -> float:
    """Return the pixel standard deviation: as given, or from the median absolute residual, px."""
    if pixel_sigma is not None:
        return float(pixel_sigma)
    return float(np.maximum(MAD_TO_SIGMA * np.median(np.abs(residuals[inliers])), _SIGMA_FLOOR))


def outlier_limits(
    residuals: Float[np.ndarray, "views points 2"],
    inliers: Bool[np.ndarray, "views points"],
    sigma: float,
    options: CommonCameraOptions,
    previous: Float[np.ndarray, "views"] | None = None,
) -> Float[np.ndarray, "views"]:
    """Return the largest squared residual of a good measurement in each view, px^2.

    A target or a lens of another shape than its model misfits some views more than others, in all
    their points. By the noise of all views together these would be outliers, and the fit without
    them still farther off; so a view is judged by its own median where that is larger. Where the
    noise is known it decides alone.

    A point near the limit moves the median of its view, and so the limit, when it is rejected. To
    prevent it from being rejected and readmitted for ever, a limit changes only if the median has
    changed by more than its standard error.

    Args:
        residuals: measured minus projected pixels.
        inliers: the observations used.
        sigma: standard deviation of u and of v over all views, px.
        options: the gate, and whether the noise is known.
        previous: the limits of the last iteration; None in the first.
    """
    variances = np.full(len(residuals), sigma**2)
    if options.pixel_sigma is None:
        medians = medians_by_view(np.linalg.norm(residuals, axis=-1), inliers) / _MEDIAN_LENGTH
        variances = np.fmax(variances, np.minimum(medians, _MAX_VIEW_RATIO * sigma) ** 2)
    limits = options.gate * variances
    if previous is None:
        return limits
    # The squared median of n lengths has the relative standard error 1 / (log(2) sqrt(n)).
    error = 1.0 / (np.log(2.0) * np.sqrt(np.maximum(inliers.sum(axis=1), 1)))
    return np.where(np.abs(limits - previous) <= error * previous, previous, limits)
