"""Fit one camera to all views by an iterated extended Kalman filter (Step 2 of the paper, Eq. 9).

The state of Eq. 9, `(s, e^1 .. e^M)`, holds the camera and the pose of every view,
`n_camera + 6 M` numbers (5 + 6 M with the paper's lens). It is updated with one two-dimensional
measurement at a time. A measurement depends on the camera and the pose of one view only, but it
corrects the whole state, because the camera correlates all views.

Step 1 gives the mean only. Its estimates come from these same pixels, so the initial covariance is
deliberately wide. Every further pass starts from that wide covariance again and keeps only the
linearisation point; otherwise the data would count twice. The fixed point of the passes is the
least-squares optimum, since one pass solves the linearised problem. A pass that raises the cost is
rejected and repeated with a narrower initial covariance, which has the effect of damping.

Outliers are rejected by a chi-square gate on the innovation, but not before the pose of their view
is determined.

Poses are parameterised by a rotation about the centroid of the visible points. For one plane seen
from similar directions the cost has a narrow valley, in which focal length, distance and tilt vary
together. With rotations about the camera the target is displaced as it tilts; the valley is then
curved, and linearised passes advance along it very slowly.

References: Kosaka and Kak's model-based stereo; Bell and Cathey 1993, who show that the iterated
filter is the Gauss-Newton method.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from ..compilation import compiled, compiled_optimised
from ..dataset import Observations
from ..geometry import transform_points

MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal variable to its median absolute deviation."""

_GATING_CHANGE_THRESHOLD = 3.0
"""Change of the state, in its standard deviations, below which the outlier gate is switched on.

Earlier, all points of a view whose pose is still wrong would look like outliers."""

_MAX_RELATIVE_COST_INCREASE = 0.01
"""Fraction by which a pass may raise the cost once the gate is on.

The points rejected during a pass are not exactly those with large residuals after it."""

_MAX_GATED_PASSES = 25
"""Maximum number of passes with the gate on; the set of outliers may alternate for ever."""

_MIN_VARIANCE_SCALE = 1e-10
"""Fraction of the initial variances at which the filter stops if a pass still raises the cost."""

_SIGMA_FLOOR = 1e-3
"""Smallest pixel standard deviation, px; noise-free data would make it zero."""


class KalmanResult(eqx.Module):
    """The result of Step 2: the common camera, the pose of every view, and their covariance.

    Attributes:
        camera: intrinsics and lens.
        camera_from_world: one pose per view; the start pose for a view without visible points.
        covariance: of the camera's numbers, followed by one tangent (translation, rotation) per
            view that acts on its pose from the left.
        inliers: the observations used.
        pixel_sigma: standard deviation of u and of v, px: as given, or estimated.
        rms: root mean square reprojection error of the inliers with these poses, px.
        passes: number of passes.
        converged: whether the last pass changed the state by less than a thousandth of its
            standard deviation.
        message: the outcome in words.
    """

    camera: Camera
    camera_from_world: SE3
    covariance: Float[Array, "state state"]
    inliers: Bool[Array, "views points"]
    pixel_sigma: Float[Array, ""]
    rms: Float[Array, ""]
    passes: int = eqx.field(static=True)
    converged: bool = eqx.field(static=True)
    message: str = eqx.field(static=True)


def kalman_filter(
    observations: Observations,
    start_camera: Camera,
    start_camera_from_world: SE3,
    start_inliers: Bool[Array, "views points"] | None = None,
    pixel_sigma: float | None = None,
    gate_probability: float = 0.9999,
    maximum_passes: int = 100,
    hold_camera: bool = False,
    progress: Callable[[str], None] | None = None,
) -> KalmanResult:
    """Estimate one camera and one pose per view from all observations (Eq. 9).

    Args:
        observations: points, pixels, visibility; the robot's poses are not used.
        start_camera, start_camera_from_world: the first linearisation point, from Step 1.
        start_inliers: observations not yet known to be outliers (Step 1 rejects gross errors).
            They are used until the state has settled; from then on the gate decides.
        pixel_sigma: standard deviation of u and of v, px; by default estimated robustly before
            each pass.
        gate_probability: probability that the innovation of a good measurement passes the gate
            (chi-square with two degrees of freedom).
        maximum_passes: over the data; three to ten are usual, a hundred if Step 1 was far off.
        hold_camera: treat the camera as known and refine the poses only.
        progress: called with a sentence about every pass.
    """
    # Quantile of chi-square with two degrees of freedom: P(x <= g) = 1 - exp(-g / 2).
    gate = -2.0 * np.log1p(-gate_probability)
    state = (start_camera, start_camera_from_world)
    visible = observations.visible
    inliers = visible if start_inliers is None else visible & start_inliers
    gating = False
    variance_scale, message = 1.0, "the passes did not settle"
    converged, passes, gated_passes = False, 0, 0
    covariance = jnp.full((0, 0), jnp.nan)
    for passes in range(1, maximum_passes + 1):
        gated_passes += gating
        if gated_passes > _MAX_GATED_PASSES:
            message = "the outliers kept changing"
            break
        sigma = robust_sigma(observations, state, inliers, pixel_sigma)
        trial = _run_pass(
            observations,
            state,
            inliers,
            sigma,
            jnp.asarray(gate),
            jnp.asarray(variance_scale),
            jnp.asarray(hold_camera),
            jnp.asarray(gating),
        )
        if progress is not None:
            progress(
                f"pass {passes}: sigma {sigma:.3f} px, changed by {trial.max_change:.2g} sigma"
            )
        if not _is_acceptable(trial, float(sigma), gating):
            # The step left the range of the linearisation: start narrower, that is, damp more.
            variance_scale = 0.1 * variance_scale
            if variance_scale < _MIN_VARIANCE_SCALE:
                message = "the passes kept raising the cost"
                break
            continue
        max_change = float(trial.max_change)
        inliers_unchanged = bool(jnp.all(trial.inliers == inliers))
        state, inliers, covariance = trial.state, trial.inliers, trial.covariance
        # A damped pass makes a short step anywhere, and its covariance is too small: only an
        # undamped pass may switch the gate on or end the iteration.
        undamped = variance_scale == 1.0
        gating = gating or (undamped and max_change < _GATING_CHANGE_THRESHOLD)
        if max_change < 1e-3 and inliers_unchanged and gating and undamped:
            converged, message = True, f"settled after {passes} passes"
            break
        variance_scale = min(1.0, 10.0 * variance_scale)
    sigma = robust_sigma(observations, state, inliers, pixel_sigma)
    rms = _rms(observations, state, inliers)
    if not bool(jnp.isfinite(rms)):
        converged, message = False, "the filter diverged: its state is not finite"
    return KalmanResult(*state, covariance, inliers, sigma, rms, passes, converged, message)


class _PassResult(NamedTuple):
    """The result of one pass over all measurements."""

    state: tuple[Camera, SE3]
    covariance: Array
    inliers: Array
    max_change: Array  # largest change of the state, in its own standard deviations
    costs: Array  # mean squared reprojection error before and after, px^2, same observations


def _is_acceptable(trial: _PassResult, sigma: float, gating: bool) -> bool:
    """Return whether a pass may be accepted; a cost of NaN is rejected."""
    before, after = np.asarray(trial.costs)
    # Rounding, and a step of a thousandth of a standard deviation, may raise the cost this much.
    allowed = (_MAX_RELATIVE_COST_INCREASE if gating else 0.0) * before + 1e-6 * sigma**2
    return bool(after <= before + allowed)


@compiled
def _rms(observations: Observations, state: tuple[Camera, SE3], inliers: Array) -> Array:
    """Return the root mean square reprojection error of the inliers, px."""
    residuals = jnp.where(inliers[..., None], pixel_residuals(observations, *state), 0.0)
    return jnp.sqrt(jnp.sum(residuals**2) / jnp.maximum(jnp.sum(inliers.astype(float)), 1.0))


def pixel_residuals(observations: Observations, camera: Camera, camera_from_world: SE3) -> Array:
    """Return measured minus projected pixels; 1e4 px for a visible point without projection."""
    predicted, valid = camera.project(transform_points(camera_from_world, observations.points))
    residuals = observations.residuals(predicted, valid)
    return jnp.where((observations.visible & ~valid)[..., None], 1e4, residuals)


@compiled
def robust_sigma(
    observations: Observations,
    state: tuple[Camera, SE3],
    inliers: Bool[Array, "views points"],
    pixel_sigma: float | None,
) -> Float[Array, ""]:
    """Return the pixel standard deviation: as given, or from the median absolute residual, px."""
    if pixel_sigma is not None:
        return jnp.asarray(pixel_sigma, dtype=float)
    residuals = jnp.where(inliers[..., None], pixel_residuals(observations, *state), jnp.nan)
    return jnp.maximum(MAD_TO_SIGMA * jnp.nanmedian(jnp.abs(residuals)), _SIGMA_FLOOR)


def initial_standard_deviations(camera: Camera, camera_from_world: SE3) -> tuple[Array, Array]:
    """Return the initial standard deviations of the state.

    They are wide because the start from Step 1 was computed from the same pixels (see the module's
    docstring).

    Returns:
        `(n_camera,)` for the camera (a quarter of alpha; for u0, v0 a quarter of the picture's
        size; for a lens coefficient the change that displaces the picture's corner by a quarter of
        the width, not below 1) and `(views, 6)` for the poses (half the distance, half a radian).
    """
    camera_parameters, rebuild = ravel_pytree(camera)
    width, height = camera.image_size
    # The picture's corner as a ray with z = 1, half the picture from the optical axis.
    corner = jnp.stack([width / camera.alpha_u, height / camera.alpha_v, jnp.asarray(2.0)]) / 2.0
    jacobian = jax.jacfwd(lambda n: rebuild(n).project(corner[None])[0][0])(camera_parameters)
    corner_displacement = jnp.max(jnp.abs(jacobian[:, 4:]), axis=0)
    pinhole_sigma = jnp.stack(
        [
            0.25 * camera.alpha_u,
            0.25 * camera.alpha_v,
            jnp.asarray(0.25 * width),
            jnp.asarray(0.25 * height),
        ]
    )
    # Outside the domain of the lens the derivative at the corner is zero or NaN; use 1 there.
    lens_sigma = jnp.where(
        corner_displacement > 1e-6 * width,
        jnp.maximum(0.25 * width / corner_displacement, 1.0),
        1.0,
    )
    # Poses: half the distance (m) for the translation, half a radian for the rotation.
    distance = jnp.linalg.norm(camera_from_world.translation(), axis=-1, keepdims=True)
    half = jnp.full((len(distance), 3), 0.5)
    return jnp.concatenate([pinhole_sigma, lens_sigma]), jnp.concatenate(
        [half * distance, half], axis=1
    )


@compiled_optimised
def _run_pass(
    observations: Observations,
    state: tuple[Camera, SE3],
    inliers: Bool[Array, "views points"],
    sigma: Float[Array, ""],
    gate: Float[Array, ""],
    variance_scale: Float[Array, ""],
    hold_camera: Bool[Array, ""],
    gating: Bool[Array, ""],
) -> _PassResult:
    """Update the state with all measurements once, from the wide initial covariance.

    The residuals are linear in the change x of the state, `r = J x + noise`, with x ~ N(0, P0) and
    the noise N(0, sigma^2 I). Scaled by the initial standard deviations, P0 = I.
    """
    camera, poses = state
    camera_parameters, rebuild = ravel_pytree(camera)
    camera_sigma, pose_sigma = initial_standard_deviations(camera, poses)
    # A known camera keeps its columns, with a variance of practically zero: one program for both.
    camera_sigma = jnp.where(hold_camera, 1e-12 * camera_sigma, camera_sigma)
    # Scale to unit initial variances, so that lengths, angles and focal lengths are comparable.
    scale = jnp.sqrt(variance_scale) * jnp.concatenate([camera_sigma, pose_sigma.ravel()])
    residuals = pixel_residuals(observations, camera, poses)
    centroid = _centroid_translations(observations, poses)
    J_camera, J_pose = _jacobians(observations, camera_parameters, rebuild, poses)
    # Rotate about the centroid, exp(x) -> m exp(x) m^-1: by the chain rule J becomes J Ad(m).
    J_pose = jnp.einsum("vnij,vjk->vnik", J_pose, centroid.adjoint())
    J_camera = J_camera * camera_sigma[None, None, None] * jnp.sqrt(variance_scale)
    J_pose = J_pose * pose_sigma[:, None, None] * jnp.sqrt(variance_scale)

    measurements = _interleave(observations, residuals, J_camera, J_pose, inliers)
    (change, covariance, _), _ = jax.lax.scan(
        _measurement_update(sigma, jnp.where(gating, gate, jnp.inf), len(camera_parameters)),
        (jnp.zeros(len(scale)), jnp.eye(len(scale)), jnp.zeros(len(poses.wxyz_xyz))),
        measurements,
    )
    # Both are relative to the initial standard deviations, which cancel in the ratio.
    max_change = jnp.max(jnp.abs(change) / jnp.sqrt(jnp.maximum(jnp.diag(covariance), 1e-30)))
    change = change * scale
    translation, rotation = jnp.split(change[len(camera_parameters) :].reshape(-1, 6), 2, axis=-1)
    # Translation and rotation are applied separately. The exponential of the whole twist is a
    # screw motion, in which a target that recedes is also displaced sideways.
    step = SE3.from_rotation_and_translation(SO3.exp(rotation), translation)
    new_state = (
        rebuild(camera_parameters + change[: len(camera_parameters)]),
        centroid @ step @ centroid.inverse() @ poses,
    )
    covariance = covariance * scale[:, None] * scale[None]

    # Points with large residuals after this pass are rejected in the next; points that fit again
    # are readmitted. The cost caps each squared residual at the gate, so that rejecting a point
    # does not lower it.
    before = jnp.sum(residuals**2, axis=-1)
    after = jnp.sum(pixel_residuals(observations, *new_state) ** 2, axis=-1)
    inside_gate = observations.visible & (after <= gate * sigma**2)
    new_inliers = jnp.where(gating, inside_gate, inliers)
    counted = jnp.where(gating, observations.visible, inliers)
    max_squared_residual = jnp.where(gating, gate * sigma**2, jnp.inf)
    costs = [
        jnp.sum(jnp.where(counted, jnp.minimum(r, max_squared_residual), 0.0))
        for r in (before, after)
    ]
    costs = jnp.stack(costs) / jnp.maximum(jnp.sum(counted.astype(float)), 1.0)
    return _PassResult(
        new_state, _covariance_about_camera(covariance, centroid), new_inliers, max_change, costs
    )


def _centroid_translations(observations: Observations, poses: SE3) -> SE3:
    """Return `(M)` translations to the centroid of each view's visible points, camera frame, m."""
    seen = observations.visible[..., None]
    total = jnp.sum(jnp.where(seen, transform_points(poses, observations.points), 0.0), axis=1)
    return SE3.from_translation(total / jnp.maximum(jnp.sum(seen.astype(float), axis=1), 1.0))


def _covariance_about_camera(covariance: Array, centroid: SE3) -> Array:
    """Return the covariance for pose tangents about the camera, from tangents about the centroids.

    A tangent x about the centroid m is `Ad(m) x` about the camera, so `P -> Ad P Ad'`.
    """
    adjoints = centroid.adjoint()
    camera_size = len(covariance) - 6 * len(adjoints)

    def transform_rows(rows: Array) -> Array:
        """Return the rows with every pose block multiplied by its adjoint from the left."""
        poses = rows[camera_size:].reshape(*adjoints.shape[:2], -1)
        return jnp.concatenate([rows[:camera_size], (adjoints @ poses).reshape(-1, rows.shape[1])])

    return transform_rows(transform_rows(covariance).T)


def _jacobians(
    observations: Observations, camera_parameters: Array, rebuild: Callable, poses: SE3
) -> tuple[Array, Array]:
    """Return the derivatives of the predicted pixels by the camera and by the poses.

    Returns:
        `(M, N, 2, n_camera)` and `(M, N, 2, 6)`, for pose tangents acting from the left.
    """

    def predict(camera_parameters, tangent, pose, point):
        """Return the pixel of one point with the pose displaced to `exp(tangent) @ pose`.

        These are the collinearity equations Eq. 5 and Eq. 6 through the lens. (Eq. 7 prints t_x
        in the rows where t_y and t_z belong, a misprint.)
        """
        pixel, valid = rebuild(camera_parameters).project(
            (SE3.exp(tangent) @ SE3(pose)).apply(point)
        )
        return jnp.where(valid, pixel, 0.0)

    derivatives = jax.jacfwd(predict, argnums=(0, 1))
    per_view = jax.vmap(derivatives, in_axes=(None, None, None, 0))
    return jax.vmap(per_view, in_axes=(None, None, 0, 0))(
        camera_parameters, jnp.zeros(6), poses.wxyz_xyz, observations.points
    )


class _Measurement(NamedTuple):
    """A pixel measurement with its derivatives and view index; `used` masks absent ones."""

    residual: Array
    J_camera: Array
    J_pose: Array
    view: Array
    used: Array


def _interleave(
    observations: Observations, residuals: Array, J_camera: Array, J_pose: Array, inliers: Array
) -> _Measurement:
    """Order the measurements point by point over all views, not view by view.

    The camera is then determined early in the pass, and gating can begin.
    """
    views, points = inliers.shape

    def flatten(x):
        """Return an array over (views, points) as one over measurements, points outermost."""
        return jnp.swapaxes(x, 0, 1).reshape(views * points, *x.shape[2:])

    view = jnp.tile(jnp.arange(views), points)
    used = flatten(inliers & observations.visible)
    return _Measurement(flatten(residuals), flatten(J_camera), flatten(J_pose), view, used)


def _measurement_update(sigma: Array, gate: Array, camera_size: int) -> Callable:
    """Return the Kalman update for one two-dimensional measurement, as the body of a scan.

        S = H P H' + sigma^2 I              covariance of the innovation
        K = P H' S^-1                       gain
        mean <- mean + K (r - H mean)
        P <- P - K H P

    With the Cholesky factor `S = L L'` this is `K (r - H mean) = (L^-1 H P)' L^-1 (r - H mean)` and
    `K H P = (L^-1 H P)' (L^-1 H P)`: P stays symmetric, and each update has rank two. The gate
    rejects a measurement with `(r - H mean)' S^-1 (r - H mean) > gate`.
    """

    def update(carry, measurement):
        """Update mean and covariance, unless the measurement is masked or gated out."""
        mean, P, point_counts = carry
        residual, J_camera, J_pose, view, used = measurement
        pose_offset = camera_size + 6 * view
        # H is zero except for the columns of the camera and of one view (11 for the paper's
        # lens), so H P needs only those rows of P.
        HP = J_camera @ P[:camera_size] + J_pose @ jax.lax.dynamic_slice_in_dim(P, pose_offset, 6)
        pose_columns = jax.lax.dynamic_slice_in_dim(HP, pose_offset, 6, axis=1)
        # H P H': the covariance of the predicted pixel, from the uncertainty of the state alone.
        predicted_covariance = HP[:, :camera_size] @ J_camera.T + pose_columns @ J_pose.T
        S = predicted_covariance + sigma**2 * jnp.eye(2)
        pose_mean = jax.lax.dynamic_slice_in_dim(mean, pose_offset, 6)
        # The innovation r - H mean: what the updates so far do not explain of this residual.
        innovation = residual - J_camera @ mean[:camera_size] - J_pose @ pose_mean
        L = jnp.linalg.cholesky(S)
        whitened = jax.scipy.linalg.solve_triangular(L, innovation, lower=True)
        # No gating until the pose of the view is determined (small predicted variance, and four
        # or more points used): before, its predictions are poor and good points would be rejected.
        determined = (jnp.trace(predicted_covariance) < 25.0 * sigma**2) & (
            point_counts[view] >= 4.0
        )
        accept = used & ((jnp.sum(whitened**2) <= gate) | ~determined)
        whitened_HP = jax.scipy.linalg.solve_triangular(L, HP, lower=True)
        weight = accept.astype(float)
        mean = mean + weight * (whitened_HP.T @ whitened)
        P = P - weight * (whitened_HP.T @ whitened_HP)
        return (mean, P, point_counts.at[view].add(weight)), accept

    return update
