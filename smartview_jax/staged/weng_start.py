"""Where Weng's method starts in a view: camera and pose by linear equations alone."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float

from ..cameras import Camera, Radial
from ..compilation import compiled
from ..geometry import nearest_rotation

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
        """The camera with these numbers and the paper's lens."""
        alpha_u, alpha_v, u0, v0, k1 = self
        return Camera(alpha_u, alpha_v, u0, v0, Radial(k1), image_size)


class Start(NamedTuple):
    """A first guess; of a plane both poses that look alike from afar, else the same twice."""

    intrinsics: Intrinsics
    poses: SE3


@compiled
def extents(
    points: Float[Array, "views points 3"], visible: Bool[Array, "views points"]
) -> Float[Array, "views 3"]:
    """Extent of the visible points along their own three axes, the smallest first, m."""
    scatter = jax.vmap(_scatter)(points, visible)
    return jnp.sqrt(jnp.maximum(jnp.linalg.eigvalsh(scatter), 0.0))


def coplanar(extent: Float[Array, "views 3"]) -> Bool[Array, "views"]:
    """Whether the points lie in one plane, whichever way it is turned."""
    return extent[:, 0] < _COPLANAR * extent[:, 2]


def planar_start(
    points: Float[Array, "points 3"],
    pixels: Float[Array, "points 2"],
    visible: Bool[Array, "points"],
    centre: Float[Array, "2"],
    size: Float[Array, ""],
) -> Start:
    """Alpha and the pose from the homography of a plane, the principal point being known.

    With square pixels Zhang's two constraints on `h1, h2` are linear in `1 / alpha^2`.

    Args:
        points, pixels, visible: of one view; pixels finite everywhere.
        centre: the principal point, px.
        size: of the picture's longer side, px: bounds what alpha can be.
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
    return Start(Intrinsics(alpha, alpha, centre[0], centre[1], k1), SE3(jnp.stack(poses)))


def linear_start(
    points: Float[Array, "points 3"],
    pixels: Float[Array, "points 2"],
    visible: Bool[Array, "points"],
) -> Start:
    """Weng's first step: eleven parameters of the projection, taken apart into camera and pose.

    The rotation found so is not quite one. The nearest rotation is kept, and with it held the
    camera and the translation are solved for once more, linearly.
    """
    (a, s), (b, r) = _similarity(points, visible), _similarity(pixels, visible)
    p = (points - a[None]) / s
    uv = (pixels - b[None]) / r
    rotation, pinhole, translation = _take_apart(_projection(p, uv, visible), p, visible)
    pinhole, translation = _with_rotation_held(rotation, pinhole, translation, p, uv, visible)
    # Back to pixels and metres.
    alpha, centre = r * pinhole[:2], r * pinhole[2:] + b
    pose = _pose(rotation, s * translation, a)
    found = Intrinsics(alpha[0], alpha[1], centre[0], centre[1], jnp.zeros(()))
    return Start(found, SE3(jnp.stack([pose, pose])))


def _projection(p: Array, uv: Array, visible: Array) -> Array:
    """The 3x4 matrix that maps points to pixels, up to its scale."""
    p1 = jnp.concatenate([p, jnp.ones_like(p[:, :1])], axis=1)
    zero = jnp.zeros_like(p1)
    weight = visible.astype(float)[:, None]
    rows = [
        jnp.concatenate([p1, zero, -uv[:, :1] * p1], axis=1) * weight,
        jnp.concatenate([zero, p1, -uv[:, 1:] * p1], axis=1) * weight,
    ]
    return _null_vector(jnp.concatenate(rows)).reshape(3, 4)


def _take_apart(W: Array, p: Array, visible: Array) -> tuple[Array, Array, Array]:
    """Rotation, `(alpha_u, alpha_v, u0, v0)` and translation of a projection (Weng, section IV)."""
    depth = jnp.sum(jnp.where(visible, p @ W[2, :3] + W[2, 3], 0.0))
    W = W * jnp.where(depth >= 0.0, 1.0, -1.0) / jnp.linalg.norm(W[2, :3])
    centre = W[:2, :3] @ W[2, :3]
    rows = W[:2] - centre[:, None] * W[2:]
    alpha = jnp.linalg.norm(rows[:, :3], axis=1)
    rows = rows / alpha[:, None]
    rotation = nearest_rotation(jnp.concatenate([rows[:, :3], W[2:, :3]]))
    translation = jnp.concatenate([rows[:, 3], W[2:, 3]])
    return rotation, jnp.concatenate([alpha, centre]), translation


def _with_rotation_held(
    rotation: Array, pinhole: Array, translation: Array, p: Array, uv: Array, visible: Array
) -> tuple[Array, Array]:
    """Weng's second linear step; the first answer stays where this one makes no camera.

    With `q = R p` and `w = alpha t + centre t_z`, `alpha q_xy + w + centre q_z - uv t_z = uv q_z`
    is linear in `(alpha_u, alpha_v, w_u, w_v, u0, v0, t_z)`.
    """
    q = p @ rotation.T
    one, zero = jnp.ones(len(q)), jnp.zeros(len(q))
    weight = visible.astype(float)
    rows_u = jnp.stack([q[:, 0], zero, one, zero, q[:, 2], zero, -uv[:, 0]], axis=1)
    rows_v = jnp.stack([zero, q[:, 1], zero, one, zero, q[:, 2], -uv[:, 1]], axis=1)
    A = jnp.concatenate([rows_u * weight[:, None], rows_v * weight[:, None]])
    right = jnp.concatenate([uv[:, 0] * q[:, 2] * weight, uv[:, 1] * q[:, 2] * weight])
    x = jnp.linalg.solve(A.T @ A + 1e-12 * jnp.eye(7), A.T @ right)
    alpha, w, centre, depth = x[:2], x[2:4], x[4:6], x[6]
    sound = jnp.all(alpha > 0.0) & jnp.all(jnp.where(visible, q[:, 2] + depth > 0.0, True))
    moved = jnp.concatenate([(w - centre * depth) / jnp.where(sound, alpha, 1.0), depth[None]])
    return (
        jnp.where(sound, jnp.concatenate([alpha, centre]), pinhole),
        jnp.where(sound, moved, translation),
    )


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


def _scatter(points: Array, visible: Array) -> Array:
    weight = visible.astype(float)[:, None]
    centred = (points - _mean(points, visible)[None]) * weight
    return centred.T @ centred


def _mean(points: Array, visible: Array) -> Array:
    weight = visible.astype(float)[:, None]
    return jnp.sum(points * weight, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)


def _similarity(values: Array, visible: Array) -> tuple[Array, Array]:
    """Centre and scale that bring points to the size of one, which makes the linear solve sound."""
    centre = _mean(values, visible)
    spread = jnp.sum(jnp.where(visible[:, None], (values - centre[None]) ** 2, 0.0))
    count = jnp.maximum(jnp.sum(visible.astype(float)), 1.0)
    return centre, jnp.sqrt(spread / count) + 1e-12


def _null_vector(rows: Array) -> Array:
    _, vectors = jnp.linalg.eigh(rows.T @ rows)
    return vectors[:, 0]


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
