"""Compute camera and pose of one view by linear equations, as the start of Weng's method.

Points in space: the direct linear transform of the 3x4 projection matrix (`linear_start`).
Points in one plane: the homography, with a known principal point (`planar_start`). Both ignore
distortion. Reference: Weng, Cohen, Herniou, PAMI 14(10), 1992, section IV.

Both are computed once, from small arrays, so that NumPy does it, for all views at a time. The
numbers of a view that does not determine its start may be infinite or NaN.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..cameras import Camera, Radial
from ..dataset import mean_point, scatter
from ..geometry import host_nearest_rotation, host_poses, host_rotations_between, host_transforms
from ..runtime.array_namespace import AnyArray

HostArray = np.ndarray
"""A NumPy array with one entry for each view along its first axis."""


class Intrinsics(NamedTuple):
    """The paper's five intrinsics (px; k1 without unit), each a scalar or one entry per view."""

    alpha_u: AnyArray
    alpha_v: AnyArray
    u0: AnyArray
    v0: AnyArray
    k1: AnyArray

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


def view_starts(
    points: Float[np.ndarray, "views points 3"],
    pixels: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
    flat: Bool[np.ndarray, "views"],
    centre: Float[np.ndarray, "2"],
    longer_side: float,
) -> Start:
    """Compute the linear start of every view, for coplanar or for spatial points.

    Args:
        points, pixels, visible: of all views; pixels finite everywhere.
        flat: the views whose points lie in one plane.
        centre, longer_side: as for `planar_start`.
    """
    numbers, poses = np.zeros((5, len(flat))), np.zeros((len(flat), 2, 7))
    for chosen in (flat, ~flat):
        if chosen.any():
            seen = points[chosen], pixels[chosen], visible[chosen]
            planar = chosen is flat
            start = planar_start(*seen, centre, longer_side) if planar else linear_start(*seen)
            numbers[:, chosen], poses[chosen] = start.intrinsics, start.poses.wxyz_xyz
    return Start(Intrinsics(*numbers), SE3(poses))  # pyright: ignore[reportArgumentType]


def planar_start(
    points: Float[np.ndarray, "views points 3"],
    pixels: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
    centre: Float[np.ndarray, "2"],
    longer_side: float,
) -> Start:
    """Compute alpha and the pose from the homography of a plane, given the principal point.

    With alpha_u = alpha_v = alpha, Zhang's two constraints on the columns `h1, h2` of the
    homography (orthogonal, of equal length) are linear in `1 / alpha^2`:

        (h11 h12 + h21 h22) / alpha^2 + h31 h32 = 0
        (h11^2 + h21^2 - h12^2 - h22^2) / alpha^2 + h31^2 - h32^2 = 0

    Args:
        points, pixels, visible: of all views; pixels finite everywhere.
        centre: the principal point, px.
        longer_side: of the picture, px; alpha is accepted between 1/5 and 30 times it.
    """
    # Coordinates within the plane: its two principal axes; the normal completes the frame.
    origin = mean_point(points, visible)
    axes = np.linalg.eigh(scatter(points, visible)).eigenvectors
    first, second = axes[..., 2], axes[..., 1]
    plane = np.stack([first, second, np.cross(first, second)], axis=1)
    plane_coordinates = (points - origin[:, None]) @ plane[:, :2].swapaxes(1, 2)
    H = _homography(plane_coordinates, pixels - centre, visible)
    alpha = _alpha_of_homography(H, longer_side)

    # diag(alpha, alpha, 1)^-1 H = scale [r1 r2 t]; the scale makes r1, r2 unit vectors, and its
    # sign puts the target in front of the camera.
    with np.errstate(all="ignore"):
        columns = H / np.stack([alpha, alpha, np.ones_like(alpha)], axis=1)[..., None]
        lengths = np.linalg.norm(columns, axis=1)
        scale = np.where(columns[:, 2, 2] > 0.0, 1.0, -1.0) / np.sqrt(lengths[:, 0] * lengths[:, 1])
        columns = columns * scale[:, None, None]
        r1, r2, t = (columns[..., k] for k in range(3))
        rotation = host_nearest_rotation(np.stack([r1, r2, np.cross(r1, r2)], axis=2))
        line_of_sight = t / np.linalg.norm(t, axis=1, keepdims=True)
        # A small plane looks almost the same when its normal is mirrored about the line of sight.
        normal = rotation[..., 2]
        cosine = np.sum(line_of_sight * normal, axis=1, keepdims=True)
        mirror_rotation = host_rotations_between(normal, 2.0 * cosine * line_of_sight - normal)
        poses = [
            _pose_parameters(R @ plane, t, origin) for R in (rotation, mirror_rotation @ rotation)
        ]
    ones = np.ones_like(alpha)
    intrinsics = Intrinsics(alpha, alpha, centre[0] * ones, centre[1] * ones, 0.0 * ones)
    return Start(intrinsics, SE3(np.stack(poses, axis=1)))  # pyright: ignore[reportArgumentType]


def _alpha_of_homography(H: HostArray, longer_side: float) -> HostArray:
    """Return alpha by Zhang's constraints; 1.2 times the longer side where they give none."""
    # The constraints are p / alpha^2 + q = 0, so 1 / alpha^2 = -p.q / p.p by least squares.
    squares = np.sum(H[:, :2] ** 2, axis=1)
    p = np.stack([np.sum(H[:, :2, 0] * H[:, :2, 1], axis=1), squares[:, 0] - squares[:, 1]])
    q = np.stack([H[:, 2, 0] * H[:, 2, 1], H[:, 2, 0] ** 2 - H[:, 2, 1] ** 2])
    inverse_square = -np.sum(p * q, axis=0) / np.maximum(np.sum(p * p, axis=0), 1e-300)
    usable = (inverse_square > 1.0 / (30.0 * longer_side) ** 2) & (
        inverse_square < (5.0 / longer_side) ** 2
    )
    return np.where(usable, 1.0 / np.sqrt(np.where(usable, inverse_square, 1.0)), 1.2 * longer_side)


def linear_start(
    points: Float[np.ndarray, "views points 3"],
    pixels: Float[np.ndarray, "views points 2"],
    visible: Bool[np.ndarray, "views points"],
) -> Start:
    """Compute camera and pose from the eleven parameters of the projection matrix, linearly.

    The rotation found in this manner is not exactly orthogonal. The nearest rotation is kept, and
    camera and translation are solved for again, linearly, with that rotation held.
    """
    # Normalised points and pixels; without this the linear system is ill-conditioned.
    a, s = _normalising_similarity(points, visible)
    b, r = _normalising_similarity(pixels, visible)
    p = (points - a[:, None]) / s[:, None, None]
    uv = (pixels - b[:, None]) / r[:, None, None]
    with np.errstate(all="ignore"):
        rotation, pinhole, translation = _decompose_projection(
            _projection_matrix(p, uv, visible), p, visible
        )
        pinhole, translation = _solve_with_fixed_rotation(
            rotation, pinhole, translation, p, uv, visible
        )
        # Undo the normalisation of points and pixels: back to pixels and metres.
        alpha_u, alpha_v = (r[:, None] * pinhole[:, :2]).T
        u0, v0 = (r[:, None] * pinhole[:, 2:] + b).T
        pose = _pose_parameters(rotation, s[:, None] * translation, a)
    intrinsics = Intrinsics(alpha_u, alpha_v, u0, v0, np.zeros_like(u0))
    return Start(intrinsics, SE3(np.stack([pose, pose], axis=1)))  # pyright: ignore[reportArgumentType]


def _projection_matrix(p: HostArray, uv: HostArray, visible: HostArray) -> HostArray:
    """Return the 3x4 matrix W that maps points to pixels, up to its scale.

    The collinearity condition (Eq. 5 and Eq. 6) with camera and pose multiplied out is
    `u = (w1.p + w14) / (w3.p + w34)`, `v = (w2.p + w24) / (w3.p + w34)`. Times the denominator it
    is linear in W. Eq. 7 of the paper is not followed: it prints t_x in the rows where t_y and t_z
    belong, a misprint.
    """
    p1 = np.concatenate([p, np.ones_like(p[..., :1])], axis=2)
    zero = np.zeros_like(p1)
    rows = [
        np.concatenate([p1, zero, -uv[..., :1] * p1], axis=2),
        np.concatenate([zero, p1, -uv[..., 1:] * p1], axis=2),
    ]
    return _null_vector([row * visible[..., None] for row in rows]).reshape(-1, 3, 4)


def _decompose_projection(
    W: HostArray, p: HostArray, visible: HostArray
) -> tuple[HostArray, HostArray, HostArray]:
    """Return rotation, `(alpha_u, alpha_v, u0, v0)` and translation of a projection matrix.

    With rows scaled so that `|w3| = 1`:

        w3 = r3,  w1 = alpha_u r1 + u0 r3,  w2 = alpha_v r2 + v0 r3

    so that `u0 = w1.w3`, `v0 = w2.w3`, and alpha is the length of the rest (Weng, section IV).
    """
    # The scale of W is free, also in sign: points must be in front of the camera.
    depths = np.einsum("vnk,vk->vn", p, W[:, 2, :3]) + W[:, 2, 3:]
    sign = np.where(np.sum(np.where(visible, depths, 0.0), axis=1) >= 0.0, 1.0, -1.0)
    W = W * (sign / np.linalg.norm(W[:, 2, :3], axis=1))[:, None, None]
    third = W[:, 2:]
    centre = np.sum(W[:, :2, :3] * third[..., :3], axis=2)
    rows = W[:, :2] - centre[..., None] * third
    alpha = np.linalg.norm(rows[..., :3], axis=2)
    rows = np.concatenate([rows / alpha[..., None], third], axis=1)
    rotation = host_nearest_rotation(rows[..., :3])
    return rotation, np.concatenate([alpha, centre], axis=1), rows[..., 3]


def _solve_with_fixed_rotation(
    rotation: HostArray,
    pinhole: HostArray,
    translation: HostArray,
    p: HostArray,
    uv: HostArray,
    visible: HostArray,
) -> tuple[HostArray, HostArray]:
    """Solve for camera and translation with the rotation held (Weng's second linear step).

    With `q = R p` and `w = alpha t + centre t_z`, `alpha q_xy + w + centre q_z - uv t_z = uv q_z`
    is linear in `(alpha_u, alpha_v, w_u, w_v, u0, v0, t_z)`. If the solution has a negative alpha
    or a point behind the camera, the arguments `pinhole` and `translation` are returned.
    """
    q = np.where(visible[..., None], p @ rotation.swapaxes(1, 2), 0.0)
    x, y, z = np.moveaxis(q, -1, 0)
    (u, v), one, zero = np.moveaxis(uv, -1, 0), visible.astype(float), np.zeros_like(x)
    A = np.concatenate(
        [
            np.stack([x, zero, one, zero, z, zero, -u * one], axis=2),
            np.stack([zero, y, zero, one, zero, z, -v * one], axis=2),
        ],
        axis=1,
    )
    right_hand_side = np.concatenate([u * z, v * z], axis=1)
    # The tiny ridge only keeps views without enough points from having no solution.
    gram = A.swapaxes(1, 2) @ A + 1e-12 * np.eye(7)
    solved = np.linalg.solve(gram, np.einsum("vni,vn->vi", A, right_hand_side)[..., None])[..., 0]
    alpha, w, centre, depth = solved[:, :2], solved[:, 2:4], solved[:, 4:6], solved[:, 6:]
    in_front = np.where(visible, z + depth > 0.0, True)
    valid = np.all(alpha > 0.0, axis=1) & np.all(in_front, axis=1)
    xy = (w - centre * depth) / np.where(valid[:, None], alpha, 1.0)
    return (
        np.where(valid[:, None], solved[:, [0, 1, 4, 5]], pinhole),
        np.where(valid[:, None], np.concatenate([xy, depth], axis=1), translation),
    )


def _homography(plane_coordinates: HostArray, pixels: HostArray, visible: HostArray) -> HostArray:
    """Return the homography from plane coordinates to pixels, by the direct linear transform."""
    a, s = _normalising_similarity(plane_coordinates, visible)
    b, r = _normalising_similarity(pixels, visible)
    x, y = np.moveaxis((plane_coordinates - a[:, None]) / s[:, None, None], -1, 0)
    u, v = np.moveaxis((pixels - b[:, None]) / r[:, None, None], -1, 0)
    ones, zero = np.ones_like(x), np.zeros_like(x)
    # u (h31 x + h32 y + h33) = h11 x + h12 y + h13, and the same for v: two equations per point,
    # linear in H.
    rows_u = np.stack([x, y, ones, zero, zero, zero, -u * x, -u * y, -u], axis=2)
    rows_v = np.stack([zero, zero, zero, x, y, ones, -v * x, -v * y, -v], axis=2)
    H = _null_vector([rows * visible[..., None] for rows in (rows_u, rows_v)]).reshape(-1, 3, 3)
    # H was found between normalised coordinates; put both similarity transforms back.
    to_pixels, from_plane = np.zeros_like(H), np.zeros_like(H)
    to_pixels[:, 0, 0] = to_pixels[:, 1, 1] = r
    to_pixels[:, :2, 2], to_pixels[:, 2, 2] = b, 1.0
    from_plane[:, 0, 0] = from_plane[:, 1, 1] = 1.0 / s
    from_plane[:, :2, 2], from_plane[:, 2, 2] = -a / s[:, None], 1.0
    return to_pixels @ H @ from_plane


def _normalising_similarity(values: HostArray, visible: HostArray) -> tuple[HostArray, HostArray]:
    """Return centre and scale that normalise points to unit size, for a well-conditioned solve."""
    centre = mean_point(values, visible)
    squares = np.where(visible[..., None], (values - centre[:, None]) ** 2, 0.0)
    count = np.maximum(np.sum(visible, axis=1), 1)
    return centre, np.sqrt(np.sum(squares, axis=(1, 2)) / count) + 1e-12


def _null_vector(rows: list[HostArray]) -> HostArray:
    """Return for each view the unit vector x that minimises `|rows x|` over all its rows."""
    stacked = np.concatenate(rows, axis=1)
    # The eigenvector of the smallest eigenvalue; `eigh` returns them in ascending order.
    return np.linalg.eigh(stacked.swapaxes(1, 2) @ stacked).eigenvectors[..., 0]


def _pose_parameters(rotation: HostArray, translation: HostArray, origin: HostArray) -> HostArray:
    """Return the pose `x -> R (x - origin) + t` as the seven numbers of an SE3."""
    shift = translation - (rotation @ origin[..., None])[..., 0]
    return np.asarray(host_transforms(host_poses(rotation, shift)).wxyz_xyz)
