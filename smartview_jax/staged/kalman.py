"""Step 2: one camera for all views, by an iterated extended Kalman filter (Eq. 9).

The state holds the camera and every view's pose, `n_camera + 6 M` numbers; it takes in one
two-dimensional measurement at a time. A measurement touches the camera's columns and six of one
view, but corrects the whole state, since the camera correlates all views.

Step 1 gives the mean only: it used these same pixels, so the start covariance is wide on purpose,
and every further pass begins with that wide covariance again and keeps only the linearisation
point. Otherwise the data would count twice. A pass is linear, so where the passes settle is the
least-squares optimum; a pass that raises the cost is not taken, and is repeated with less freedom.

A view turns about the middle of what it shows. One plane seen from few sides leaves a valley in
which focal length, distance and tilt grow together; turned about the camera, the target swings
aside as it tilts, the valley curves, and passes that are linear creep along it without an end.

Reference: Kosaka and Kak's model-based stereo, and the textbook iterated filter (Bell, Cathey 1993:
it is Gauss-Newton).
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
from ..compilation import compiled, optimised
from ..dataset import Observations
from ..geometry import transform_points

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""

_SETTLED = 3.0
"""Movement of the state, in its own sigmas, under which the gate begins to work. Before, a whole
view whose pose is still off would look like outliers."""

_ALLOWED_RISE = 0.01
"""Share by which a pass may raise the cost once the gate works: what a pass sets aside on its way
is not quite what stands out at its end."""

_GATED_PASSES = 25
"""Passes with the gate at work, after which outliers that still come and go are given up."""

_LEAST_FREEDOM = 1e-10
"""Share of the wide variances under which a pass that still raises the cost is the last."""

_SIGMA_FLOOR = 1e-3
"""Smallest pixel sigma that is believed, px; noise-free data would make it zero."""


class KalmanResult(eqx.Module):
    """The camera that all views share, their poses, and how well both are known.

    Attributes:
        camera: intrinsics and lens.
        camera_from_world: one pose a view; the start's where a view shows nothing.
        covariance: of the camera's numbers, then a tangent a view (translation, rotation) that
            acts from the left on its pose.
        inliers: the observations used.
        pixel_sigma: standard deviation of u and of v, px: as given, or estimated.
        rms: root mean square deviation of the inliers with these poses, px.
        passes: passes made.
        converged: whether the last pass moved the state by less than a thousandth of its sigma.
        message: in words.
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
    """Filter all observations into one camera and one pose a view.

    Args:
        observations: points, pixels, visibility; the robot's poses are not used.
        start_camera, start_camera_from_world: the first linearisation point, from Step 1.
        start_inliers: what is not known to be an outlier already (Step 1 sets gross ones aside).
            They are used until the state has settled; from then on the gate decides.
        pixel_sigma: of u and of v, px; by default estimated, robustly, before each pass.
        gate_probability: a measurement is set aside where its innovation is larger than this
            share of good ones (chi-square with two degrees of freedom).
        maximum_passes: over the data; three to ten are usual, a hundred where Step 1 was far off.
        hold_camera: the camera is known: refine the poses alone.
        progress: told what is being done.
    """
    gate = -2.0 * np.log1p(-gate_probability)
    point = (start_camera, start_camera_from_world)
    visible = observations.visible
    inliers = visible if start_inliers is None else visible & start_inliers
    gating = False
    freedom, message = 1.0, "the passes did not settle"
    converged, passes, gated = False, 0, 0
    covariance = jnp.full((0, 0), jnp.nan)
    for passes in range(1, maximum_passes + 1):
        gated += gating
        if gated > _GATED_PASSES:
            message = "the outliers kept changing"
            break
        sigma = robust_sigma(observations, point, inliers, pixel_sigma)
        trial = _one_pass(
            observations,
            point,
            inliers,
            sigma,
            jnp.asarray(gate),
            jnp.asarray(freedom),
            jnp.asarray(hold_camera),
            jnp.asarray(gating),
        )
        if progress is not None:
            progress(f"pass {passes}: sigma {sigma:.3f} px, moved {trial.movement:.2g} sigma")
        if not _lowers_the_cost(trial, float(sigma), gating):
            # The step went too far: trust the linearisation less.
            freedom = 0.1 * freedom
            if freedom < _LEAST_FREEDOM:
                message = "the passes kept raising the cost"
                break
            continue
        moved, same = float(trial.movement), bool(jnp.all(trial.inliers == inliers))
        point, inliers, covariance = trial.point, trial.inliers, trial.covariance
        # A pass that was held back moves little wherever it is, and knows less than it says.
        free = freedom == 1.0
        gating = gating or (free and moved < _SETTLED)
        if moved < 1e-3 and same and gating and free:
            converged, message = True, f"settled after {passes} passes"
            break
        freedom = min(1.0, 10.0 * freedom)
    sigma = robust_sigma(observations, point, inliers, pixel_sigma)
    rms = _rms(observations, point, inliers)
    if not bool(jnp.isfinite(rms)):
        converged, message = False, "the filter diverged: its state is not finite"
    return KalmanResult(*point, covariance, inliers, sigma, rms, passes, converged, message)


class _Pass(NamedTuple):
    point: tuple[Camera, SE3]
    covariance: Array
    inliers: Array
    movement: Array  # largest change of the state, in its own standard deviations
    costs: Array  # mean squared deviation before and after, px^2, over the same observations


def _lowers_the_cost(trial: _Pass, sigma: float, gating: bool) -> bool:
    """Return whether a pass may be taken; one that ends in no number may not."""
    before, after = np.asarray(trial.costs)
    # What rounding and a step of a thousandth of a sigma change is no rise.
    allowed = (_ALLOWED_RISE if gating else 0.0) * before + 1e-6 * sigma**2
    return bool(after <= before + allowed)


@compiled
def _rms(observations: Observations, point: tuple[Camera, SE3], inliers: Array) -> Array:
    residuals = jnp.where(inliers[..., None], pixel_residuals(observations, *point), 0.0)
    return jnp.sqrt(jnp.sum(residuals**2) / jnp.maximum(jnp.sum(inliers.astype(float)), 1.0))


def pixel_residuals(observations: Observations, camera: Camera, camera_from_world: SE3) -> Array:
    """Measured minus projected, px; a point that cannot be projected counts as far off."""
    predicted, valid = camera.project(transform_points(camera_from_world, observations.points))
    residuals = observations.residuals(predicted, valid)
    return jnp.where((observations.visible & ~valid)[..., None], 1e4, residuals)


@compiled
def robust_sigma(
    observations: Observations,
    point: tuple[Camera, SE3],
    inliers: Bool[Array, "views points"],
    given: float | None,
) -> Float[Array, ""]:
    if given is not None:
        return jnp.asarray(given, dtype=float)
    size = jnp.where(inliers[..., None], pixel_residuals(observations, *point), jnp.nan)
    return jnp.maximum(MAD_TO_SIGMA * jnp.nanmedian(jnp.abs(size)), _SIGMA_FLOOR)


def initial_deviations(camera: Camera, camera_from_world: SE3) -> tuple[Array, Array]:
    """Standard deviations that Step 1's answer is given: wide, for it saw the same pixels.

    Returns:
        `(n_camera,)` for the camera's numbers (a quarter of alpha, a quarter of the picture, for
        the lens what moves the picture's corner by that, and 1 at the least) and `(views, 6)` for
        the poses (half the distance, half a radian).
    """
    numbers, rebuild = ravel_pytree(camera)
    width, height = camera.image_size
    corner = jnp.stack([width / camera.alpha_u, height / camera.alpha_v, jnp.asarray(2.0)]) / 2.0
    by_number = jax.jacfwd(lambda n: rebuild(n).project(corner[None])[0][0])(numbers)
    moved = jnp.max(jnp.abs(by_number[:, 4:]), axis=0)
    pinhole = jnp.stack(
        [
            0.25 * camera.alpha_u,
            0.25 * camera.alpha_v,
            jnp.asarray(0.25 * width),
            jnp.asarray(0.25 * height),
        ]
    )
    # A corner outside the lens's domain does not move, or not by a number.
    lens = jnp.where(moved > 1e-6 * width, jnp.maximum(0.25 * width / moved, 1.0), 1.0)
    distance = jnp.linalg.norm(camera_from_world.translation(), axis=-1, keepdims=True)
    half = jnp.full((len(distance), 3), 0.5)
    return jnp.concatenate([pinhole, lens]), jnp.concatenate([half * distance, half], axis=1)


@optimised
def _one_pass(
    observations: Observations,
    point: tuple[Camera, SE3],
    inliers: Bool[Array, "views points"],
    sigma: Float[Array, ""],
    gate: Float[Array, ""],
    freedom: Float[Array, ""],
    hold_camera: Bool[Array, ""],
    gating: Bool[Array, ""],
) -> _Pass:
    camera, poses = point
    numbers, rebuild = ravel_pytree(camera)
    camera_sigma, pose_sigma = initial_deviations(camera, poses)
    camera_sigma = jnp.where(hold_camera, 1e-12 * camera_sigma, camera_sigma)
    # Unit variances to begin with: lengths, angles and focal lengths become comparable.
    scale = jnp.sqrt(freedom) * jnp.concatenate([camera_sigma, pose_sigma.ravel()])
    residuals = pixel_residuals(observations, camera, poses)
    middle = _middles(observations, poses)
    J_camera, J_pose = _jacobians(observations, numbers, rebuild, poses)
    J_pose = jnp.einsum("vnij,vjk->vnik", J_pose, middle.adjoint())
    J_camera = J_camera * camera_sigma[None, None, None] * jnp.sqrt(freedom)
    J_pose = J_pose * pose_sigma[:, None, None] * jnp.sqrt(freedom)

    measurements = _interleave(observations, residuals, J_camera, J_pose, inliers)
    (change, covariance, _), _ = jax.lax.scan(
        _absorb(sigma, jnp.where(gating, gate, jnp.inf), len(numbers)),
        (jnp.zeros(len(scale)), jnp.eye(len(scale)), jnp.zeros(len(poses.wxyz_xyz))),
        measurements,
    )
    movement = jnp.max(jnp.abs(change) / jnp.sqrt(jnp.maximum(jnp.diag(covariance), 1e-30)))
    change = change * scale
    shift, turn = jnp.split(change[len(numbers) :].reshape(-1, 6), 2, axis=-1)
    # Not the exponential of both: along its screw a target that moves away swings aside too.
    step = SE3.from_rotation_and_translation(SO3.exp(turn), shift)
    new_point = (
        rebuild(numbers + change[: len(numbers)]),
        middle @ step @ middle.inverse() @ poses,
    )
    covariance = covariance * scale[:, None] * scale[None]

    # What stands out after the pass is set aside before the next, and what fits is let in again.
    before = jnp.sum(residuals**2, axis=-1)
    after = jnp.sum(pixel_residuals(observations, *new_point) ** 2, axis=-1)
    fits = observations.visible & (after <= gate * sigma**2)
    kept = jnp.where(gating, fits, inliers)
    counted = jnp.where(gating, observations.visible, inliers)
    most = jnp.where(gating, gate * sigma**2, jnp.inf)
    costs = [jnp.sum(jnp.where(counted, jnp.minimum(r, most), 0.0)) for r in (before, after)]
    costs = jnp.stack(costs) / jnp.maximum(jnp.sum(counted.astype(float)), 1.0)
    return _Pass(new_point, _about_the_camera(covariance, middle), kept, movement, costs)


def _middles(observations: Observations, poses: SE3) -> SE3:
    """Return `(M)` shifts from the middle of what each view shows, in its camera's frame."""
    seen = observations.visible[..., None]
    total = jnp.sum(jnp.where(seen, transform_points(poses, observations.points), 0.0), axis=1)
    return SE3.from_translation(total / jnp.maximum(jnp.sum(seen.astype(float), axis=1), 1.0))


def _about_the_camera(covariance: Array, middle: SE3) -> Array:
    """Return the covariance of poses that turn about their camera, from that about middles."""
    blocks = middle.adjoint()
    first = len(covariance) - 6 * len(blocks)

    def moved(rows: Array) -> Array:
        poses = rows[first:].reshape(*blocks.shape[:2], -1)
        return jnp.concatenate([rows[:first], (blocks @ poses).reshape(-1, rows.shape[1])])

    return moved(moved(covariance).T)


def _jacobians(
    observations: Observations, numbers: Array, rebuild: Callable, poses: SE3
) -> tuple[Array, Array]:
    """Derivatives of the predicted pixels: `(M, N, 2, n_camera)` and `(M, N, 2, 6)`."""

    def predict(numbers, tangent, pose, point):
        pixel, valid = rebuild(numbers).project((SE3.exp(tangent) @ SE3(pose)).apply(point))
        return jnp.where(valid, pixel, 0.0)

    both = jax.jacfwd(predict, argnums=(0, 1))
    per_view = jax.vmap(both, in_axes=(None, None, None, 0))
    return jax.vmap(per_view, in_axes=(None, None, 0, 0))(
        numbers, jnp.zeros(6), poses.wxyz_xyz, observations.points
    )


class _Measurement(NamedTuple):
    residual: Array
    J_camera: Array
    J_pose: Array
    view: Array
    use: Array


def _interleave(
    observations: Observations, residuals: Array, J_camera: Array, J_pose: Array, inliers: Array
) -> _Measurement:
    """All views take turns, so that the camera is soon determined and gating can begin."""
    views, points = inliers.shape

    def flat(x):
        return jnp.swapaxes(x, 0, 1).reshape(views * points, *x.shape[2:])

    view = jnp.tile(jnp.arange(views), points)
    use = flat(inliers & observations.visible)
    return _Measurement(flat(residuals), flat(J_camera), flat(J_pose), view, use)


def _absorb(sigma: Array, gate: Array, camera_size: int) -> Callable:
    """One measurement into the state: a rank-two correction of the mean and the covariance."""

    def absorb(carry, measurement):
        mean, P, seen = carry
        residual, J_camera, J_pose, view, use = measurement
        first = camera_size + 6 * view
        # H P with H in 11 columns or so: never the whole of H.
        HP = J_camera @ P[:camera_size] + J_pose @ jax.lax.dynamic_slice_in_dim(P, first, 6)
        pose_columns = jax.lax.dynamic_slice_in_dim(HP, first, 6, axis=1)
        predicted = HP[:, :camera_size] @ J_camera.T + pose_columns @ J_pose.T
        S = predicted + sigma**2 * jnp.eye(2)
        pose_mean = jax.lax.dynamic_slice_in_dim(mean, first, 6)
        innovation = residual - J_camera @ mean[:camera_size] - J_pose @ pose_mean
        L = jnp.linalg.cholesky(S)
        whitened = jax.scipy.linalg.solve_triangular(L, innovation, lower=True)
        # A view whose pose is still open predicts badly: nothing can be told to be wrong in it.
        determined = (jnp.trace(predicted) < 25.0 * sigma**2) & (seen[view] >= 4.0)
        accept = use & ((jnp.sum(whitened**2) <= gate) | ~determined)
        half = jax.scipy.linalg.solve_triangular(L, HP, lower=True)
        weight = accept.astype(float)
        mean = mean + weight * (half.T @ whitened)
        P = P - weight * (half.T @ half)
        return (mean, P, seen.at[view].add(weight)), accept

    return absorb
