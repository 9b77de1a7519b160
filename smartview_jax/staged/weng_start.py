"""Compute camera and pose of one view by linear equations, as the start of Weng's method.

Points in space: the direct linear transform of the 3x4 projection matrix (`linear_start`).
Points in one plane: the homography, with a known principal point (`planar_start`). Both ignore
distortion. Reference: Weng, Cohen, Herniou, PAMI 14(10), 1992, section IV.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool, Float

from ..array_namespace import AnyArray
from ..cameras import Camera, Radial
from ..compilation import compiled
from ..geometry import nearest_rotation

_COPLANARITY_TOLERANCE = 1e-3
"""Ratio of smallest to largest extent of the points below which they count as one plane."""


class Intrinsics(NamedTuple):
    """The paper's five intrinsics (px; k1 without unit), each a scalar or one entry per view."""

    alpha_u: Array
    alpha_v: Array
    u0: Array
    v0: Array
    k1: Array

    def camera(self, image_size: tuple[int, int]) -> Camera:
        """Return the pinhole camera (Eq. 2) with these intrinsics and the paper's lens (Eq. 3)."""
        alpha_u, alpha_v, u0, v0, k1 = self
        return Camera(alpha_u, alpha_v, u0, v0, Radial(k1), image_size)


class Start(NamedTuple):
    """A start value: intrinsics, and two poses to try.

    For a plane they are the two poses that look almost alike from afar; otherwise both are equal.
    """

    intrinsics: Intrinsics
    poses: SE3


@compiled
def extents(
    points: Float[Array, "views points 3"], visible: Bool[Array, "views points"]
) -> Float[Array, "views 3"]:
    """Return the extent of the visible points along their principal axes, ascending, m."""
    scatter = jax.vmap(_scatter)(points, visible)
    return jnp.sqrt(jnp.maximum(jnp.linalg.eigvalsh(scatter), 0.0))


def coplanar(extent: Float[AnyArray, "views 3"]) -> Bool[AnyArray, "views"]:
    """Return whether the points of each view lie in one plane, of any orientation."""
    return extent[:, 0] < _COPLANARITY_TOLERANCE * extent[:, 2]


def planar_start(
    points: Float[Array, "points 3"],
    pixels: Float[Array, "points 2"],
    visible: Bool[Array, "points"],
    centre: Float[Array, "2"],
    longer_side: Float[Array, ""],
) -> Start:
    """Compute alpha and the pose from the homography of a plane, given the principal point.

    With alpha_u = alpha_v = alpha, Zhang's two constraints on the columns `h1, h2` of the
    homography (orthogonal, of equal length) are linear in `1 / alpha^2`:

        (h11 h12 + h21 h22) / alpha^2 + h31 h32 = 0
        (h11^2 + h21^2 - h12^2 - h22^2) / alpha^2 + h31^2 - h32^2 = 0

    Args:
        points, pixels, visible: of one view; pixels finite everywhere.
        centre: the principal point, px.
        longer_side: of the picture, px; alpha is accepted between 1/5 and 30 times it.
    """
    # Coordinates within the plane: its two principal axes; the normal completes the frame.
    origin = _mean(points, visible)
    _, axes = jnp.linalg.eigh(_scatter(points, visible))
    plane = jnp.stack([axes[:, 2], axes[:, 1], jnp.cross(axes[:, 2], axes[:, 1])])
    plane_coordinates = (points - origin[None]) @ plane[:2].T
    H = _homography(plane_coordinates, pixels - centre[None], visible)
    # The constraints are p / alpha^2 + q = 0, so 1 / alpha^2 = -p.q / p.p by least squares.
    p = jnp.stack(
        [H[0, 0] * H[0, 1] + H[1, 0] * H[1, 1], _squared_norm(H[:2, 0]) - _squared_norm(H[:2, 1])]
    )
    q = jnp.stack([H[2, 0] * H[2, 1], H[2, 0] ** 2 - H[2, 1] ** 2])
    inverse_square = -jnp.sum(p * q) / jnp.maximum(jnp.sum(p * p), 1e-300)
    usable = (inverse_square > 1.0 / (30.0 * longer_side) ** 2) & (
        inverse_square < (5.0 / longer_side) ** 2
    )
    alpha = jnp.where(
        usable, 1.0 / jnp.sqrt(jnp.where(usable, inverse_square, 1.0)), 1.2 * longer_side
    )

    # diag(alpha, alpha, 1)^-1 H = scale [r1 r2 t]; the scale makes r1, r2 unit vectors, and its
    # sign puts the target in front of the camera.
    columns = H / jnp.stack([alpha, alpha, jnp.ones(())])[:, None]
    columns = columns / jnp.sqrt(jnp.linalg.norm(columns[:, 0]) * jnp.linalg.norm(columns[:, 1]))
    columns = columns * jnp.where(columns[2, 2] > 0.0, 1.0, -1.0)
    rotation = nearest_rotation(
        jnp.stack([columns[:, 0], columns[:, 1], jnp.cross(columns[:, 0], columns[:, 1])], axis=1)
    )
    line_of_sight = columns[:, 2] / jnp.linalg.norm(columns[:, 2])
    # A small plane looks almost the same when its normal is mirrored about the line of sight.
    normal = rotation[:, 2]
    mirrored_normal = 2.0 * jnp.sum(line_of_sight * normal) * line_of_sight - normal
    mirror_rotation = _rotation_between(normal, mirrored_normal)
    poses = [
        _pose_parameters(R @ plane, columns[:, 2], origin)
        for R in (rotation, mirror_rotation @ rotation)
    ]
    k1 = jnp.zeros(())
    return Start(Intrinsics(alpha, alpha, centre[0], centre[1], k1), SE3(jnp.stack(poses)))


def linear_start(
    points: Float[Array, "points 3"],
    pixels: Float[Array, "points 2"],
    visible: Bool[Array, "points"],
) -> Start:
    """Compute camera and pose from the eleven parameters of the projection matrix, linearly.

    The rotation found in this manner is not exactly orthogonal. The nearest rotation is kept, and
    camera and translation are solved for again, linearly, with that rotation held.
    """
    # Normalised points and pixels; without this the linear system is ill-conditioned.
    a, s = _normalising_similarity(points, visible)
    b, r = _normalising_similarity(pixels, visible)
    p = (points - a[None]) / s
    uv = (pixels - b[None]) / r
    rotation, pinhole, translation = _decompose_projection(
        _projection_matrix(p, uv, visible), p, visible
    )
    pinhole, translation = _solve_with_fixed_rotation(
        rotation, pinhole, translation, p, uv, visible
    )
    # Undo the normalisation of points and pixels: back to pixels and metres.
    alpha, centre = r * pinhole[:2], r * pinhole[2:] + b
    pose = _pose_parameters(rotation, s * translation, a)
    intrinsics = Intrinsics(alpha[0], alpha[1], centre[0], centre[1], jnp.zeros(()))
    return Start(intrinsics, SE3(jnp.stack([pose, pose])))


def _projection_matrix(p: Array, uv: Array, visible: Array) -> Array:
    """Return the 3x4 matrix W that maps points to pixels, up to its scale.

    The collinearity condition (Eq. 5 and Eq. 6) with camera and pose multiplied out is
    `u = (w1.p + w14) / (w3.p + w34)`, `v = (w2.p + w24) / (w3.p + w34)`. Times the denominator it
    is linear in W. Eq. 7 of the paper is not followed: it prints t_x in the rows where t_y and t_z
    belong, a misprint.
    """
    p1 = jnp.concatenate([p, jnp.ones_like(p[:, :1])], axis=1)
    zero = jnp.zeros_like(p1)
    weight = visible.astype(float)[:, None]
    rows = [
        jnp.concatenate([p1, zero, -uv[:, :1] * p1], axis=1) * weight,
        jnp.concatenate([zero, p1, -uv[:, 1:] * p1], axis=1) * weight,
    ]
    return _null_vector(jnp.concatenate(rows)).reshape(3, 4)


def _decompose_projection(W: Array, p: Array, visible: Array) -> tuple[Array, Array, Array]:
    """Return rotation, `(alpha_u, alpha_v, u0, v0)` and translation of a projection matrix.

    With rows scaled so that `|w3| = 1`:

        w3 = r3,  w1 = alpha_u r1 + u0 r3,  w2 = alpha_v r2 + v0 r3

    so that `u0 = w1.w3`, `v0 = w2.w3`, and alpha is the length of the rest (Weng, section IV).
    """
    # The scale of W is free, also in sign: points must be in front of the camera.
    depth = jnp.sum(jnp.where(visible, p @ W[2, :3] + W[2, 3], 0.0))
    W = W * jnp.where(depth >= 0.0, 1.0, -1.0) / jnp.linalg.norm(W[2, :3])
    centre = W[:2, :3] @ W[2, :3]
    rows = W[:2] - centre[:, None] * W[2:]
    alpha = jnp.linalg.norm(rows[:, :3], axis=1)
    rows = rows / alpha[:, None]
    rotation = nearest_rotation(jnp.concatenate([rows[:, :3], W[2:, :3]]))
    translation = jnp.concatenate([rows[:, 3], W[2:, 3]])
    return rotation, jnp.concatenate([alpha, centre]), translation


def _solve_with_fixed_rotation(
    rotation: Array, pinhole: Array, translation: Array, p: Array, uv: Array, visible: Array
) -> tuple[Array, Array]:
    """Solve for camera and translation with the rotation held (Weng's second linear step).

    With `q = R p` and `w = alpha t + centre t_z`, `alpha q_xy + w + centre q_z - uv t_z = uv q_z`
    is linear in `(alpha_u, alpha_v, w_u, w_v, u0, v0, t_z)`. If the solution has a negative alpha
    or a point behind the camera, the arguments `pinhole` and `translation` are returned.
    """
    q = p @ rotation.T
    ones, zero = jnp.ones(len(q)), jnp.zeros(len(q))
    weight = visible.astype(float)
    rows_u = jnp.stack([q[:, 0], zero, ones, zero, q[:, 2], zero, -uv[:, 0]], axis=1)
    rows_v = jnp.stack([zero, q[:, 1], zero, ones, zero, q[:, 2], -uv[:, 1]], axis=1)
    A = jnp.concatenate([rows_u * weight[:, None], rows_v * weight[:, None]])
    right_hand_side = jnp.concatenate([uv[:, 0] * q[:, 2] * weight, uv[:, 1] * q[:, 2] * weight])
    # The tiny ridge only keeps views without enough points from returning NaN.
    x = jnp.linalg.solve(A.T @ A + 1e-12 * jnp.eye(7), A.T @ right_hand_side)
    alpha, w, centre, depth = x[:2], x[2:4], x[4:6], x[6]
    valid = jnp.all(alpha > 0.0) & jnp.all(jnp.where(visible, q[:, 2] + depth > 0.0, True))
    solved_translation = jnp.concatenate(
        [(w - centre * depth) / jnp.where(valid, alpha, 1.0), depth[None]]
    )
    return (
        jnp.where(valid, jnp.concatenate([alpha, centre]), pinhole),
        jnp.where(valid, solved_translation, translation),
    )


def _homography(plane_coordinates: Array, pixels: Array, visible: Array) -> Array:
    """Return the homography from plane coordinates to pixels, by the direct linear transform."""
    a, s = _normalising_similarity(plane_coordinates, visible)
    b, r = _normalising_similarity(pixels, visible)
    x, y = ((plane_coordinates - a[None]) / s).T
    u, v = ((pixels - b[None]) / r).T
    ones, zero = jnp.ones_like(x), jnp.zeros_like(x)
    # u (h31 x + h32 y + h33) = h11 x + h12 y + h13, and likewise for v: two equations per point,
    # linear in H.
    rows_u = jnp.stack([x, y, ones, zero, zero, zero, -u * x, -u * y, -u], axis=1)
    rows_v = jnp.stack([zero, zero, zero, x, y, ones, -v * x, -v * y, -v], axis=1)
    weight = visible.astype(float)[:, None]
    H = _null_vector(jnp.concatenate([rows_u * weight, rows_v * weight])).reshape(3, 3)
    # H was found between normalised coordinates; put both similarity transforms back.
    to_pixels = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) * r
    to_pixels = to_pixels.at[:2, 2].set(b).at[2, 2].set(1.0)
    from_plane = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]) / s
    from_plane = from_plane.at[:2, 2].set(-a / s).at[2, 2].set(1.0)
    return to_pixels @ H @ from_plane


def _scatter(points: Array, visible: Array) -> Array:
    """Return the scatter matrix of the visible points about their mean."""
    weight = visible.astype(float)[:, None]
    centred = (points - _mean(points, visible)[None]) * weight
    return centred.T @ centred


def _mean(points: Array, visible: Array) -> Array:
    """Return the mean of the visible points."""
    weight = visible.astype(float)[:, None]
    return jnp.sum(points * weight, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)


def _normalising_similarity(values: Array, visible: Array) -> tuple[Array, Array]:
    """Return centre and scale that normalise points to unit size, for a well-conditioned solve."""
    centre = _mean(values, visible)
    sum_of_squares = jnp.sum(jnp.where(visible[:, None], (values - centre[None]) ** 2, 0.0))
    count = jnp.maximum(jnp.sum(visible.astype(float)), 1.0)
    return centre, jnp.sqrt(sum_of_squares / count) + 1e-12


def _null_vector(rows: Array) -> Array:
    """Return the unit vector x that minimises `|rows x|`."""
    # The eigenvector of the smallest eigenvalue; `eigh` returns them in ascending order.
    _, vectors = jnp.linalg.eigh(rows.T @ rows)
    return vectors[:, 0]


def _pose_parameters(rotation: Array, translation: Array, origin: Array) -> Array:
    """Return the pose `x -> R (x - origin) + t` as the seven numbers of an SE3."""
    pose = SE3.from_rotation_and_translation(
        SO3.from_matrix(rotation), translation - rotation @ origin
    )
    return pose.wxyz_xyz


def _squared_norm(vector: Array) -> Array:
    """Return the squared length of a vector."""
    return jnp.sum(vector**2)


def _rotation_between(start: Array, end: Array) -> Array:
    """Return the smallest rotation that takes one unit vector to another.

    `R = I + K + K^2 / (1 + cos)`, with K the cross-product matrix of `start x end`.
    """
    axis, cosine = jnp.cross(start, end), jnp.sum(start * end)
    K = jnp.cross(jnp.eye(3), axis[None]).T
    return jnp.eye(3) + K + K @ K / jnp.maximum(1.0 + cosine, 1e-6)
