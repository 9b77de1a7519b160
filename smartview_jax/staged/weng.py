"""Step 1: each view calibrated by itself, by Weng's two-step method.

A linear start, then in turn: pose and pinhole numbers by nonlinear least squares with the
distortion held, and the distortion by *linear* least squares with the rest held (the paper's lens
maps distorted to ideal coordinates, so it is linear there). Each turn is kept only if it lowers
Eq. 8, read as measured minus projected pixels (as printed it mixes pixels with normalised units).

The linear start needs points that are not in one plane. A single plane cannot tell the principal
point from the pose: there u0, v0 stay at the picture's centre and alpha_u = alpha_v, which come
from the homography; a frontal view cannot tell even that and takes the median of the others.

Reference: Weng, Cohen, Herniou, PAMI 14(10), 1992.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera, Radial
from ..dataset import Observations
from ..geometry import nearest_rotation, transform_points

LINEAR, PLANAR, MEDIAN = (
    "linear",
    "one plane: centre held, alpha_u = alpha_v",
    "frontal: alpha of the other views",
)

_DETERMINED = 0.03
"""Relative standard deviation of alpha above which a view does not determine it."""
_COPLANAR = 1e-3
"""Smallest over largest extent of the points, under which they count as one plane."""


class Intrinsics(NamedTuple):
    """Pinhole numbers and k1, a scalar each or one a view."""

    alpha_u: Array
    alpha_v: Array
    u0: Array
    v0: Array
    k1: Array

    def camera(self, image_size: tuple[int, int]) -> Camera:
        alpha_u, alpha_v, u0, v0, k1 = self
        return Camera(alpha_u, alpha_v, u0, v0, Radial(k1), image_size)


class ViewCalibrations(eqx.Module):
    """What Step 1 found for each view.

    Attributes:
        intrinsics: the view's own; see `starts` for what was held.
        camera_from_world: the view's pose.
        rms: root mean square deviation over the points used, px.
        alpha_std: relative standard deviation of alpha in that view.
        used: the points that were not set aside as gross outliers.
        starts: which start each view took.
    """

    intrinsics: Intrinsics
    camera_from_world: SE3
    rms: Float[Array, "views"]
    alpha_std: Float[Array, "views"]
    used: Bool[Array, "views points"]
    starts: tuple[str, ...] = eqx.field(static=True)

    def camera(self, view: int, image_size: tuple[int, int]) -> Camera:
        """The camera as one view sees it."""
        return Intrinsics(*(value[view] for value in self.intrinsics)).camera(image_size)


def calibrate_views(
    observations: Observations, image_size: tuple[int, int], distortion: bool = True
) -> ViewCalibrations:
    """Calibrate every view by itself.

    Args:
        observations: views with at least 6 visible points (4 where they lie in one plane).
        image_size: width and height, px.
        distortion: estimate k1; False keeps it at zero.
    """
    centre = (np.array(image_size, dtype=float) - 1.0) / 2.0
    coplanar = np.array(_coplanar(observations.points, observations.visible))
    size = jnp.asarray(float(max(image_size)))
    start = _starts(observations, jnp.asarray(centre), size, jnp.asarray(coplanar))
    free = np.tile([True, True, True, True], (len(coplanar), 1))
    free[coplanar, 1:] = False
    found = _calibrate_all(observations, start, jnp.asarray(free), jnp.asarray(distortion))

    alpha_std = np.array(found.alpha_std)
    shown = np.asarray(observations.visible).any(axis=1)
    frontal = ~(alpha_std < _DETERMINED)
    starts = [
        MEDIAN if frontal[i] else PLANAR if coplanar[i] else LINEAR for i in range(len(coplanar))
    ]
    if frontal.any():
        # Where no view is oblique the least uncertain ones must do.
        trusted = shown & ~frontal
        if not trusted.any():
            trusted = shown & (alpha_std <= np.nanmedian(alpha_std[shown]))
        median = jax.tree.map(lambda x: np.median(np.asarray(x)[trusted]), found.intrinsics)
        held = _hold_alpha(start, median, frontal, centre)
        free[frontal] = False
        found = _calibrate_all(observations, held, jnp.asarray(free), jnp.asarray(distortion))
    return ViewCalibrations(
        found.intrinsics,
        found.camera_from_world,
        found.rms,
        jnp.asarray(alpha_std),
        found.used,
        tuple(starts),
    )


def locate_views(
    observations: Observations, camera: Camera
) -> tuple[SE3, Float[Array, "views"], Bool[Array, "views points"]]:
    """The pose of every view under a camera that is known: `camera_from_world`, rms, points used.

    The pictures are straightened first, so any lens will do.
    """
    pixels = jnp.where(observations.visible[..., None], observations.pixels, 0.0)
    rays, valid = camera.unproject(pixels)
    valid = valid & (rays[..., 2] > 1e-3)
    rays = jnp.where(valid[..., None], rays, 1.0)
    centre = jnp.zeros(2)
    straight = Observations(
        observations.points,
        camera.alpha_u * rays[..., :2] / rays[..., 2:],
        observations.visible & valid,
        observations.base_from_tool,
    )
    coplanar = _coplanar(straight.points, straight.visible)
    size = jnp.asarray(float(max(camera.image_size)))
    every = np.ones(len(coplanar), dtype=bool)
    alpha, zero = camera.alpha_u, jnp.zeros(())
    known = Intrinsics(alpha, alpha, zero, zero, zero)
    start = _starts(straight, centre, size, coplanar)
    held = _hold_alpha(start, known, every, np.zeros(2))
    nothing = jnp.zeros((len(coplanar), 4), dtype=bool)
    found = _calibrate_all(straight, held, nothing, jnp.asarray(False))
    return found.camera_from_world, found.rms, found.used


class _Start(NamedTuple):
    intrinsics: Intrinsics
    poses: SE3  # (views, 2): both tilts of a plane that look alike from afar


class _Found(NamedTuple):
    intrinsics: Intrinsics
    camera_from_world: SE3
    rms: Array
    alpha_std: Array
    used: Array


def _hold_alpha(
    start: _Start, median: Intrinsics, frontal: np.ndarray, centre: np.ndarray
) -> _Start:
    """The start with the median intrinsics in frontal views, at the depth that fits them."""
    chosen = jnp.asarray(frontal)
    ratio = median.alpha_u / start.intrinsics.alpha_u
    held = Intrinsics(median.alpha_u, median.alpha_u, centre[0], centre[1], median.k1)
    intrinsics = jax.tree.map(
        lambda value, new: jnp.where(chosen, jnp.full_like(value, new), value),
        start.intrinsics,
        held,
    )
    depth = start.poses.wxyz_xyz[..., 6] * jnp.where(chosen, ratio, 1.0)[:, None]
    return _Start(intrinsics, SE3(start.poses.wxyz_xyz.at[..., 6].set(depth)))


@jax.jit
def _coplanar(
    points: Float[Array, "views points 3"], visible: Bool[Array, "views points"]
) -> Bool[Array, "views"]:
    scatter = jax.vmap(_scatter)(points, visible)
    extent = jnp.sqrt(jnp.maximum(jnp.linalg.eigvalsh(scatter), 0.0))
    return extent[:, 0] < _COPLANAR * extent[:, 2]


def _scatter(points: Array, visible: Array) -> Array:
    weight = visible.astype(float)[:, None]
    centred = (points - _mean(points, visible)[None]) * weight
    return centred.T @ centred


def _mean(points: Array, visible: Array) -> Array:
    weight = visible.astype(float)[:, None]
    return jnp.sum(points * weight, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)


@jax.jit
def _starts(observations: Observations, centre: Array, size: Array, coplanar: Array) -> _Start:
    def one(points, pixels, visible, planar):
        flat = _planar_start(points, pixels, visible, centre, size)
        solid = _linear_start(points, pixels, visible)
        return jax.tree.map(lambda a, b: jnp.where(planar, a, b), flat, solid)

    pixels = jnp.where(observations.visible[..., None], observations.pixels, 0.0)
    return jax.vmap(one)(observations.points, pixels, observations.visible, coplanar)


def _planar_start(
    points: Array, pixels: Array, visible: Array, centre: Array, size: Array
) -> _Start:
    """Alpha and the pose from the homography of a plane, the principal point being known.

    With square pixels Zhang's two constraints on `h1, h2` are linear in `1 / alpha^2`.
    """
    origin = _mean(points, visible)
    _, axes = jnp.linalg.eigh(_scatter(points, visible))
    plane = jnp.stack([axes[:, 2], axes[:, 1], jnp.cross(axes[:, 2], axes[:, 1])])
    local = (points - origin[None]) @ plane[:2].T
    H = _homography(local, pixels - centre[None], visible)
    p = jnp.stack([H[0, 0] * H[0, 1] + H[1, 0] * H[1, 1], _norm2(H[:2, 0]) - _norm2(H[:2, 1])])
    q = jnp.stack([H[2, 0] * H[2, 1], H[2, 0] ** 2 - H[2, 1] ** 2])
    inverse_square = -jnp.sum(p * q) / jnp.maximum(jnp.sum(p * p), 1e-300)
    usable = (inverse_square > 1.0 / (30.0 * size) ** 2) & (inverse_square < (5.0 / size) ** 2)
    alpha = jnp.where(usable, 1.0 / jnp.sqrt(jnp.where(usable, inverse_square, 1.0)), 1.2 * size)

    columns = H / jnp.stack([alpha, alpha, jnp.ones(())])[:, None]
    columns = columns / jnp.sqrt(jnp.linalg.norm(columns[:, 0]) * jnp.linalg.norm(columns[:, 1]))
    columns = columns * jnp.where(columns[2, 2] > 0.0, 1.0, -1.0)
    rotation = nearest_rotation(
        jnp.stack([columns[:, 0], columns[:, 1], jnp.cross(columns[:, 0], columns[:, 1])], axis=1)
    )
    sight = columns[:, 2] / jnp.linalg.norm(columns[:, 2])
    # Tilted the other way about the line of sight, a small plane looks almost the same.
    normal = rotation[:, 2]
    mirrored = 2.0 * jnp.sum(sight * normal) * sight - normal
    turn = _rotation_between(normal, mirrored)
    poses = [_pose(R @ plane, columns[:, 2], origin) for R in (rotation, turn @ rotation)]
    k1 = jnp.zeros(())
    return _Start(Intrinsics(alpha, alpha, centre[0], centre[1], k1), SE3(jnp.stack(poses)))


def _pose(rotation: Array, translation: Array, origin: Array) -> Array:
    pose = SE3.from_rotation_and_translation(
        SO3.from_matrix(rotation), translation - rotation @ origin
    )
    return pose.wxyz_xyz


def _norm2(vector: Array) -> Array:
    return jnp.sum(vector**2)


def _rotation_between(start: Array, end: Array) -> Array:
    axis, cosine = jnp.cross(start, end), jnp.sum(start * end)
    K = jnp.cross(jnp.eye(3), axis[None]).T
    return jnp.eye(3) + K + K @ K / jnp.maximum(1.0 + cosine, 1e-6)


def _similarity(values: Array, visible: Array) -> tuple[Array, Array]:
    """Centre and scale that bring points to the size of one, which makes the linear solve sound."""
    centre = _mean(values, visible)
    spread = jnp.sum(jnp.where(visible[:, None], (values - centre[None]) ** 2, 0.0))
    return centre, jnp.sqrt(spread / jnp.maximum(jnp.sum(visible.astype(float)), 1.0)) + 1e-12


def _null_vector(rows: Array) -> Array:
    _, vectors = jnp.linalg.eigh(rows.T @ rows)
    return vectors[:, 0]


def _homography(local: Array, pixels: Array, visible: Array) -> Array:
    """Pixel from plane coordinates, by the direct linear transform."""
    (a, s), (b, r) = _similarity(local, visible), _similarity(pixels, visible)
    x, y = ((local - a[None]) / s).T
    u, v = ((pixels - b[None]) / r).T
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    rows_u = jnp.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1)
    rows_v = jnp.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1)
    weight = visible.astype(float)[:, None]
    H = _null_vector(jnp.concatenate([rows_u * weight, rows_v * weight])).reshape(3, 3)
    to_pixels = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) * r
    to_pixels = to_pixels.at[:2, 2].set(b).at[2, 2].set(1.0)
    from_local = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) / s
    from_local = from_local.at[:2, 2].set(-a / s).at[2, 2].set(1.0)
    return to_pixels @ H @ from_local


def _linear_start(points: Array, pixels: Array, visible: Array) -> _Start:
    """Weng's first step: eleven parameters of the projection, taken apart into camera and pose."""
    (a, s), (b, r) = _similarity(points, visible), _similarity(pixels, visible)
    p = (points - a[None]) / s
    u, v = ((pixels - b[None]) / r).T
    p1 = jnp.concatenate([p, jnp.ones_like(p[:, :1])], axis=1)
    zero = jnp.zeros_like(p1)
    rows = [
        jnp.concatenate([p1, zero, -u[:, None] * p1], axis=1),
        jnp.concatenate([zero, p1, -v[:, None] * p1], axis=1),
    ]
    weight = visible.astype(float)[:, None]
    W = _null_vector(jnp.concatenate([row * weight for row in rows])).reshape(3, 4)
    depth = jnp.sum(jnp.where(visible, p1 @ W[2], 0.0))
    W = W * jnp.where(depth >= 0.0, 1.0, -1.0) / jnp.linalg.norm(W[2, :3])
    # Back to pixels and metres: W maps normalised points to normalised pixels.
    W = jnp.concatenate([W[:2] * r + b[:, None] * W[2:], W[2:]])
    u0, v0 = W[0, :3] @ W[2, :3], W[1, :3] @ W[2, :3]
    alpha_u = jnp.linalg.norm(W[0, :3] - u0 * W[2, :3])
    alpha_v = jnp.linalg.norm(W[1, :3] - v0 * W[2, :3])
    rows_R = [(W[0, :3] - u0 * W[2, :3]) / alpha_u, (W[1, :3] - v0 * W[2, :3]) / alpha_v, W[2, :3]]
    rotation = nearest_rotation(jnp.stack(rows_R))
    translation = jnp.stack(
        [(W[0, 3] - u0 * W[2, 3]) / alpha_u, (W[1, 3] - v0 * W[2, 3]) / alpha_v, W[2, 3]]
    )
    pose = _pose(rotation, s * translation, a)
    return _Start(Intrinsics(alpha_u, alpha_v, u0, v0, jnp.zeros(())), SE3(jnp.stack([pose, pose])))


@jax.jit
def _calibrate_all(
    observations: Observations, start: _Start, free: Array, distortion: Array
) -> _Found:
    def one(points, pixels, visible, intrinsics, poses, free):
        both = jax.vmap(
            lambda pose: _calibrate_view(
                points, pixels, visible, intrinsics, SE3(pose), free, distortion
            )
        )(poses.wxyz_xyz)
        best = jnp.nanargmin(jnp.where(jnp.isfinite(both.rms), both.rms, jnp.inf))
        return jax.tree.map(lambda x: x[best], both)

    pixels = jnp.where(observations.visible[..., None], observations.pixels, 0.0)
    return jax.vmap(one)(
        observations.points, pixels, observations.visible, start.intrinsics, start.poses, free
    )


class _State(NamedTuple):
    shape: Array  # log alpha, log (alpha_v / alpha_u), u0, v0
    k1: Array
    pose: SE3


def _calibrate_view(
    points: Array,
    pixels: Array,
    visible: Array,
    intrinsics: Intrinsics,
    pose: SE3,
    free: Array,
    distortion: Array,
) -> _Found:
    """Weng's alternation, then again without the points that stand out."""
    alpha_u, alpha_v, u0, v0, k1 = intrinsics
    ratio = jnp.where(free[1], jnp.log(alpha_v / alpha_u), 0.0)
    state = _State(jnp.stack([jnp.log(alpha_u), ratio, u0, v0]), k1, pose)

    def trim(_, carry):
        """Gross outliers give way in a few rounds, the largest first."""
        state, used = carry
        state = _alternate(state, points, pixels, used, free, distortion, rounds=5)
        size = jnp.linalg.norm(_residuals(state, points, pixels, visible), axis=-1)
        scale = jnp.nanmedian(jnp.where(visible, size, jnp.nan))
        return state, visible & (size <= 5.0 * scale + 1e-6)

    state, used = jax.lax.fori_loop(0, 6, trim, (state, visible))

    residuals = _residuals(state, points, pixels, used)
    count = jnp.sum(used).astype(float)
    J = _jacobian(state, points, pixels, used, free)
    JtJ = J.T @ J + jnp.diag(jnp.where(_free10(free), 1e-12, 1.0))
    variance = jnp.sum(residuals**2) / jnp.maximum(2.0 * count - 7.0, 1.0)
    covariance = jnp.linalg.inv(JtJ) * jnp.maximum(variance, 0.05**2)
    alpha_std = jnp.where(free[0], jnp.sqrt(jnp.maximum(covariance[0, 0], 0.0)), jnp.inf)
    log_alpha, log_ratio, u0, v0 = state.shape
    found = Intrinsics(jnp.exp(log_alpha), jnp.exp(log_alpha + log_ratio), u0, v0, state.k1)
    rms = jnp.sqrt(jnp.sum(residuals**2) / jnp.maximum(count, 1.0))
    return _Found(found, state.pose, rms, alpha_std, used)


def _residuals(state: _State, points: Array, pixels: Array, used: Array) -> Array:
    """Eq. 8: measured minus projected pixels; points that cannot be projected count as far off."""
    log_alpha, log_ratio, u0, v0 = state.shape
    camera = Intrinsics(
        jnp.exp(log_alpha), jnp.exp(log_alpha + log_ratio), u0, v0, state.k1
    ).camera((1, 1))
    predicted, valid = camera.project(transform_points(state.pose, points))
    residual = jnp.where(valid[:, None], pixels - jnp.where(valid[:, None], predicted, 0.0), 1e4)
    return jnp.where(used[:, None], residual, 0.0)


def _moved(state: _State, step: Array) -> _State:
    pose = SE3.exp(step[4:]) @ state.pose
    return _State(state.shape + step[:4], state.k1, pose)


def _free10(free: Array) -> Array:
    return jnp.concatenate([free, jnp.ones(6, dtype=bool)])


def _jacobian(state: _State, points: Array, pixels: Array, used: Array, free: Array) -> Array:
    def residuals(step):
        return _residuals(_moved(state, step), points, pixels, used).ravel()

    return jax.jacfwd(residuals)(jnp.zeros(10)) * _free10(free)[None].astype(float)


def _alternate(
    state: _State,
    points: Array,
    pixels: Array,
    used: Array,
    free: Array,
    distortion: Array,
    rounds: int,
) -> _State:
    def cost(state):
        return jnp.sum(_residuals(state, points, pixels, used) ** 2)

    def pose_and_pinhole(state, damping):
        """One damped Gauss-Newton step with the distortion held."""
        J = _jacobian(state, points, pixels, used, free)
        r = _residuals(state, points, pixels, used).ravel()
        JtJ = J.T @ J
        scale = jnp.diag(JtJ) + jnp.where(jnp.diag(JtJ) > 0.0, 0.0, 1.0)
        trial = _moved(state, jnp.linalg.solve(JtJ + jnp.diag(damping * scale), -J.T @ r))
        better = cost(trial) < cost(state)
        state = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, state)
        return state, jnp.where(better, damping * 0.1, damping * 10.0)

    def radial(state):
        """k1 by linear least squares: `ideal - distorted = k1 distorted r^2`."""
        log_alpha, log_ratio, u0, v0 = state.shape
        alpha = jnp.exp(jnp.stack([log_alpha, log_alpha + log_ratio]))
        distorted = (pixels - jnp.stack([u0, v0])[None]) / alpha[None]
        p = transform_points(state.pose, points)
        weight = (used & (p[:, 2] > 0.0))[:, None].astype(float) * alpha[None]
        ideal = p[:, :2] / jnp.where(p[:, 2:] > 0.0, p[:, 2:], 1.0)
        column = distorted * jnp.sum(distorted**2, axis=1, keepdims=True) * weight
        k1 = jnp.sum(column * (ideal - distorted) * weight) / (jnp.sum(column**2) + 1e-300)
        trial = state._replace(k1=jnp.where(distortion, k1, 0.0))
        better = cost(trial) < cost(state)
        return jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, state)

    def turn(_, carry):
        state, damping = carry
        state, damping = jax.lax.fori_loop(
            0, 3, lambda _, c: pose_and_pinhole(*c), (state, damping)
        )
        return radial(state), jnp.clip(damping, 1e-9, 1e3)

    state, _ = jax.lax.fori_loop(0, rounds, turn, (state, jnp.asarray(1e-3)))
    return state
