"""Closed forms of the hand-eye problem: starts for Step 3, and a check on it.

All take the chain `camera_from_world_i = camera_from_mount @ mount_from_holder_i @
holder_from_world` and return both unknowns; for a camera on the hand the mount is the tool and the
holder the base. They do not use OpenCV, whose version 5 left its own out of the Python package. A
view of weight zero has no say, whatever its (finite) pose: a fold needs no new compilation.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..geometry import mean_pose, nearest_rotation


def holder_from_world(
    camera_from_mount: SE3,
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"],
) -> SE3:
    """The other unknown once one is known, averaged over the views."""
    per_view = SE3(camera_from_mount.wxyz_xyz[None]) @ mount_from_holder
    return mean_pose(per_view.inverse() @ camera_from_world, weights)


def motion_pairs(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3, Float[Array, "pairs"]]:
    """`A X = X B` for `X = camera_from_mount`, over all ordered pairs of different views."""
    views = len(mount_from_holder.wxyz_xyz)
    first, second = jnp.nonzero(~jnp.eye(views, dtype=bool), size=views * (views - 1))

    def between(poses: SE3) -> SE3:
        return SE3(poses.wxyz_xyz[second]) @ SE3(poses.wxyz_xyz[first]).inverse()

    return between(camera_from_world), between(mount_from_holder), weights[first] * weights[second]


def park_martin(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Rotation from the rotation vectors, then translation. Park and Martin, 1994."""
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    rotation = nearest_rotation((w[:, None] * A.rotation().log()).T @ B.rotation().log())
    return _with_translation(rotation, A, B, w, mount_from_holder, camera_from_world, weights)


def tsai_lenz(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Rotation from modified Rodrigues vectors, then translation. Tsai and Lenz, 1989."""
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    # 2 sin(angle / 2) axis, from the quaternion on the half with a positive scalar part.
    a, b = (
        2.0 * q[:, 1:] * jnp.where(q[:, :1] < 0.0, -1.0, 1.0)
        for q in (A.rotation().wxyz, B.rotation().wxyz)
    )
    skew = (w[:, None, None] * _skew(a + b)).reshape(-1, 3)
    vector = jnp.linalg.lstsq(skew, (w[:, None] * (b - a)).reshape(-1))[0]
    p = 2.0 * vector / jnp.sqrt(1.0 + jnp.sum(vector**2))
    square = jnp.sum(p**2)
    rotation = (1.0 - 0.5 * square) * jnp.eye(3) + 0.5 * (
        jnp.outer(p, p) + jnp.sqrt(jnp.maximum(4.0 - square, 0.0)) * _skew(p[None])[0]
    )
    return _with_translation(
        nearest_rotation(rotation), A, B, w, mount_from_holder, camera_from_world, weights
    )


def daniilidis(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Rotation and translation at once, by dual quaternions. Daniilidis, 1999."""
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    (a, a_dual), (b, b_dual) = _dual_quaternion(A), _dual_quaternion(B)
    zero = jnp.zeros((len(a), 3, 1))
    top = jnp.concatenate([(a - b)[:, 1:, None], _skew((a + b)[:, 1:])], axis=2)
    dual = jnp.concatenate([(a_dual - b_dual)[:, 1:, None], _skew((a_dual + b_dual)[:, 1:])], 2)
    none = jnp.concatenate([zero, jnp.zeros((len(a), 3, 3))], axis=2)
    rows = jnp.concatenate(
        [jnp.concatenate([top, none], axis=2), jnp.concatenate([dual, top], axis=2)], axis=1
    )
    rows = (w[:, None, None] * rows).reshape(-1, 8)
    _, vectors = jnp.linalg.eigh(rows.T @ rows)
    v, u = vectors[:, 0], vectors[:, 1]
    # x v + y u with a unit real part that is orthogonal to the dual part.
    s = _quadratic_root(v[:4] @ v[4:], v[:4] @ u[4:] + u[:4] @ v[4:], u[:4] @ u[4:])

    def size(s):
        return s**2 * (v[:4] @ v[:4]) + 2.0 * s * (v[:4] @ u[:4]) + u[:4] @ u[:4]

    best = jnp.where(size(s[0]) >= size(s[1]), s[0], s[1])
    y = 1.0 / jnp.sqrt(jnp.maximum(size(best), 1e-300))
    q, q_dual = y * (best * v[:4] + u[:4]), y * (best * v[4:] + u[4:])
    rotation = SO3(q / jnp.linalg.norm(q))
    translation = 2.0 * _quaternion_product(q_dual, rotation.inverse().wxyz)[1:]
    hand_eye = SE3.from_rotation_and_translation(rotation, translation)
    return hand_eye, holder_from_world(hand_eye, mount_from_holder, camera_from_world, weights)


def shah(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Both unknowns of `A X = Z B` by a Kronecker product. Shah, 2013."""
    M, C = mount_from_holder.rotation().as_matrix(), camera_from_world.rotation().as_matrix()
    # C_i R_world^T M_i^T = R_camera for every view: one singular pair of the summed product.
    K = jnp.einsum("i,iab,icd->acbd", weights, M, C).reshape(9, 9)
    left, _, right = jnp.linalg.svd(K)
    camera, world = left[:, 0].reshape(3, 3).T, right[0].reshape(3, 3).T
    sign = jnp.where(jnp.linalg.det(camera) < 0.0, -1.0, 1.0)
    R_camera = nearest_rotation(sign * camera)
    R_world = nearest_rotation(sign * world * jnp.sign(jnp.linalg.det(sign * world))).T
    views = len(M)
    left_side = jnp.concatenate(
        [R_camera[None] @ M, jnp.broadcast_to(jnp.eye(3), (views, 3, 3))], axis=2
    )
    left_side = (weights[:, None, None] * left_side).reshape(-1, 6)
    moved = mount_from_holder.translation() @ R_camera.T
    right_side = (weights[:, None] * (camera_from_world.translation() - moved)).reshape(-1)
    solution = jnp.linalg.lstsq(left_side, right_side)[0]
    return (
        SE3.from_rotation_and_translation(SO3.from_matrix(R_camera), solution[3:]),
        SE3.from_rotation_and_translation(SO3.from_matrix(R_world), solution[:3]),
    )


CLOSED_FORMS: dict[str, Callable[[SE3, SE3, Array], tuple[SE3, SE3]]] = {
    "Park-Martin": park_martin,
    "Tsai-Lenz": tsai_lenz,
    "Daniilidis": daniilidis,
    "Shah": shah,
}
"""Every closed form by the name it is reported under."""


def _with_translation(
    rotation: Float[Array, "3 3"],
    A: SE3,
    B: SE3,
    w: Float[Array, "pairs"],
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"],
) -> tuple[SE3, SE3]:
    """`(R_A - I) t = R t_B - t_A` by least squares, and the other unknown."""
    left = (w[:, None, None] * (A.rotation().as_matrix() - jnp.eye(3)[None])).reshape(-1, 3)
    right = (w[:, None] * (B.translation() @ rotation.T - A.translation())).reshape(-1)
    translation = jnp.linalg.lstsq(left, right)[0]
    hand_eye = SE3.from_rotation_and_translation(SO3.from_matrix(rotation), translation)
    return hand_eye, holder_from_world(hand_eye, mount_from_holder, camera_from_world, weights)


def _skew(v: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    zero = jnp.zeros_like(v[:, 0])
    x, y, z = v.T
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _dual_quaternion(pose: SE3) -> tuple[Array, Array]:
    q = pose.rotation().wxyz
    q = q * jnp.where(q[:, :1] < 0.0, -1.0, 1.0)
    t = jnp.concatenate([jnp.zeros((len(q), 1)), pose.translation()], axis=1)
    return q, 0.5 * jnp.stack([*_product_rows(t.T, q.T)], axis=1)


def _quaternion_product(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    return jnp.stack([*_product_rows(p, q)])


def _product_rows(p: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _quadratic_root(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    root = jnp.sqrt(jnp.maximum(b * b - 4.0 * a * c, 0.0))
    q = -0.5 * (b + jnp.where(b < 0.0, -1.0, 1.0) * root)
    tiny = 1e-300
    return q / jnp.where(jnp.abs(a) > tiny, a, tiny), c / jnp.where(jnp.abs(q) > tiny, q, tiny)
