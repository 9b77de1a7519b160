"""Solve the hand-eye problem in closed form, as starts for Step 3 and as a check on it.

Every method takes the chain (Eq. 10)

    camera_from_world_i = camera_from_mount @ mount_from_holder_i @ holder_from_world

and returns both unknowns, `(camera_from_mount, holder_from_world)`. For a camera on the hand the
mount is the tool and the holder is the base. OpenCV is not used: its version 5 no longer has these
functions in its Python package. A view of weight zero does not affect the result, whatever its
(finite) pose, so that a cross-validation fold needs no new compilation.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..geometry import mean_pose, nearest_rotation


def mean_holder_from_world(
    camera_from_mount: SE3,
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"],
) -> SE3:
    """Compute `holder_from_world` for a given `camera_from_mount`, averaged over the views."""
    # Eq. 10 for one view: holder_from_world = (camera_from_mount mount_from_holder)^-1
    # camera_from_world.
    camera_from_holder = SE3(camera_from_mount.wxyz_xyz[None]) @ mount_from_holder
    return mean_pose(camera_from_holder.inverse() @ camera_from_world, weights)


def motion_pairs(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3, Float[Array, "pairs"]]:
    """Return A, B and weights of `A X = X B` for all ordered pairs of different views.

    `A = C_j C_i^-1` and `B = T_j T_i^-1` with `X = camera_from_mount`: Eq. 10 for two views with
    `holder_from_world` eliminated.
    """
    views = len(mount_from_holder.wxyz_xyz)
    first, second = jnp.nonzero(~jnp.eye(views, dtype=bool), size=views * (views - 1))

    def relative_poses(poses: SE3) -> SE3:
        """Return the motions `P_j P_i^-1` of all pairs."""
        return SE3(poses.wxyz_xyz[second]) @ SE3(poses.wxyz_xyz[first]).inverse()

    return (
        relative_poses(camera_from_world),
        relative_poses(mount_from_holder),
        weights[first] * weights[second],
    )


def park_martin(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Compute the rotation from rotation vectors, then the translation (Park and Martin, 1994).

    `R_A R = R R_B` means that R takes the rotation vectors of B to those of A, so R is the rotation
    nearest to `sum w a b^T`.
    """
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    # sum w a b^T, with the rotation vectors a and b of each pair in the rows of two matrices.
    rotation = nearest_rotation((w[:, None] * A.rotation().log()).T @ B.rotation().log())
    return _solve_translation(rotation, A, B, w, mount_from_holder, camera_from_world, weights)


def tsai_lenz(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Compute the rotation from modified Rodrigues vectors, then the translation.

    With `a, b = 2 sin(angle / 2) axis` of A and B, `skew(a + b) p' = b - a` is solved for
    `p' = tan(angle / 2) axis` of X, and `p = 2 p' / sqrt(1 + |p'|^2)` gives

        R = (1 - |p|^2 / 2) I + (p p^T + sqrt(4 - |p|^2) skew(p)) / 2

    Reference: Tsai and Lenz, 1989.
    """
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    # q and -q are the same rotation; the one with a positive scalar part has angles up to pi.
    a, b = (
        2.0 * q[:, 1:] * jnp.where(q[:, :1] < 0.0, -1.0, 1.0)
        for q in (A.rotation().wxyz, B.rotation().wxyz)
    )
    # Least squares for p' = tan(angle / 2) axis, the Rodrigues (Gibbs) vector of X.
    skew = (w[:, None, None] * _skew(a + b)).reshape(-1, 3)
    rodrigues = jnp.linalg.lstsq(skew, (w[:, None] * (b - a)).reshape(-1))[0]
    # p = 2 sin(angle / 2) axis, since sin = tan / sqrt(1 + tan^2).
    p = 2.0 * rodrigues / jnp.sqrt(1.0 + jnp.sum(rodrigues**2))
    square = jnp.sum(p**2)
    rotation = (1.0 - 0.5 * square) * jnp.eye(3) + 0.5 * (
        jnp.outer(p, p) + jnp.sqrt(jnp.maximum(4.0 - square, 0.0)) * _skew(p[None])[0]
    )
    return _solve_translation(
        nearest_rotation(rotation), A, B, w, mount_from_holder, camera_from_world, weights
    )


def daniilidis(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Compute rotation and translation together by dual quaternions (Daniilidis, 1999).

    `a q = q b` for dual quaternions is linear in the eight numbers `(q, q')` of X. The null space
    has two dimensions, and the constraints `|q| = 1`, `q . q' = 0` select the solution in it.
    """
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    (a, a_dual), (b, b_dual) = _dual_quaternion(A), _dual_quaternion(B)
    zero = jnp.zeros((len(a), 3, 1))
    # a q - q b = 0 in real and dual parts (scalar rows dropped, they are equal for exact data):
    #     [a - b    skew(a + b)     0       0        ]   [q ]
    #     [a' - b'  skew(a' + b')   a - b   skew(a + b)] [q'] = 0
    real_rows = jnp.concatenate([(a - b)[:, 1:, None], _skew((a + b)[:, 1:])], axis=2)
    dual_rows = jnp.concatenate(
        [(a_dual - b_dual)[:, 1:, None], _skew((a_dual + b_dual)[:, 1:])], 2
    )
    zero_block = jnp.concatenate([zero, jnp.zeros((len(a), 3, 3))], axis=2)
    rows = jnp.concatenate(
        [
            jnp.concatenate([real_rows, zero_block], axis=2),
            jnp.concatenate([dual_rows, real_rows], axis=2),
        ],
        axis=1,
    )
    # The eigenvectors of the two smallest eigenvalues span the null space.
    rows = (w[:, None, None] * rows).reshape(-1, 8)
    _, vectors = jnp.linalg.eigh(rows.T @ rows)
    v, u = vectors[:, 0], vectors[:, 1]
    # The solution is x v + y u = y (s v + u) with q . q' = 0, quadratic in s = x / y, and with a
    # unit real part. Of its two roots the one with the longer real part is right.
    s = _quadratic_roots(v[:4] @ v[4:], v[:4] @ u[4:] + u[:4] @ v[4:], u[:4] @ u[4:])

    def squared_norm(s):
        """Return the squared length of the real part of `s v + u`."""
        return s**2 * (v[:4] @ v[:4]) + 2.0 * s * (v[:4] @ u[:4]) + u[:4] @ u[:4]

    best = jnp.where(squared_norm(s[0]) >= squared_norm(s[1]), s[0], s[1])
    y = 1.0 / jnp.sqrt(jnp.maximum(squared_norm(best), 1e-300))
    q, q_dual = y * (best * v[:4] + u[:4]), y * (best * v[4:] + u[4:])
    rotation = SO3(q / jnp.linalg.norm(q))
    # The dual part is q' = t q / 2, so the translation is the vector part of 2 q' q^-1.
    translation = 2.0 * _quaternion_product(q_dual, rotation.inverse().wxyz)[1:]
    hand_eye = SE3.from_rotation_and_translation(rotation, translation)
    return hand_eye, mean_holder_from_world(hand_eye, mount_from_holder, camera_from_world, weights)


def shah(
    mount_from_holder: SE3, camera_from_world: SE3, weights: Float[Array, "views"]
) -> tuple[SE3, SE3]:
    """Compute both transforms of `A X = Z B` by a Kronecker product (Shah, 2013).

    The rotations follow from `sum w kron(M_i, C_i)`, of which vec(R_world) and vec(R_camera) are
    the first singular pair. The translations are then linear:
    `R_camera M_i t_world + t_camera = t_C_i - R_camera t_M_i`.
    """
    M, C = mount_from_holder.rotation().as_matrix(), camera_from_world.rotation().as_matrix()
    # The rotations of Eq. 10, C_i = R_camera M_i R_world, give C_i R_world^T M_i^T = R_camera in
    # every view.
    K = jnp.einsum("i,iab,icd->acbd", weights, M, C).reshape(9, 9)
    U, _, Vt = jnp.linalg.svd(K)
    camera, world = U[:, 0].reshape(3, 3).T, Vt[0].reshape(3, 3).T
    # The sign of a pair of singular vectors is arbitrary; both matrices must be proper rotations.
    sign = jnp.where(jnp.linalg.det(camera) < 0.0, -1.0, 1.0)
    R_camera = nearest_rotation(sign * camera)
    R_world = nearest_rotation(sign * world * jnp.sign(jnp.linalg.det(sign * world))).T
    views = len(M)
    # With both rotations known, [R_camera M_i, I] [t_world; t_camera] = t_C_i - R_camera t_M_i.
    matrix = jnp.concatenate(
        [R_camera[None] @ M, jnp.broadcast_to(jnp.eye(3), (views, 3, 3))], axis=2
    )
    matrix = (weights[:, None, None] * matrix).reshape(-1, 6)
    rotated_translation = mount_from_holder.translation() @ R_camera.T
    right_hand_side = (
        weights[:, None] * (camera_from_world.translation() - rotated_translation)
    ).reshape(-1)
    solution = jnp.linalg.lstsq(matrix, right_hand_side)[0]
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
"""The closed forms, by the names under which they are reported."""


def _solve_translation(
    rotation: Float[Array, "3 3"],
    A: SE3,
    B: SE3,
    w: Float[Array, "pairs"],
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"],
) -> tuple[SE3, SE3]:
    """Solve `(R_A - I) t = R t_B - t_A` by least squares, and return both transforms."""
    # From A X = X B: R_A t + t_A = R t_B + t.
    matrix = (w[:, None, None] * (A.rotation().as_matrix() - jnp.eye(3)[None])).reshape(-1, 3)
    right_hand_side = (w[:, None] * (B.translation() @ rotation.T - A.translation())).reshape(-1)
    translation = jnp.linalg.lstsq(matrix, right_hand_side)[0]
    hand_eye = SE3.from_rotation_and_translation(SO3.from_matrix(rotation), translation)
    return hand_eye, mean_holder_from_world(hand_eye, mount_from_holder, camera_from_world, weights)


def _skew(v: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Return the cross-product matrices of vectors."""
    zero = jnp.zeros_like(v[:, 0])
    x, y, z = v.T
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _dual_quaternion(pose: SE3) -> tuple[Array, Array]:
    """Return real part q and dual part `t q / 2` of the unit dual quaternions of poses."""
    q = pose.rotation().wxyz
    # q and -q are the same rotation; the one with a positive scalar part is used.
    q = q * jnp.where(q[:, :1] < 0.0, -1.0, 1.0)
    t = jnp.concatenate([jnp.zeros((len(q), 1)), pose.translation()], axis=1)
    return q, 0.5 * jnp.stack([*_quaternion_product_components(t.T, q.T)], axis=1)


def _quaternion_product(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Return the quaternion product `p q`, scalar part first."""
    return jnp.stack([*_quaternion_product_components(p, q)])


def _quaternion_product_components(p: Array, q: Array) -> tuple[Array, Array, Array, Array]:
    """Return the four components of the quaternion product, for arrays with components first."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _quadratic_roots(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Return both roots of `a s^2 + b s + c = 0`, without cancellation."""
    # q = -(b + sign(b) sqrt_discriminant) / 2 adds numbers of equal sign; the roots are q / a and
    # c / q.
    sqrt_discriminant = jnp.sqrt(jnp.maximum(b * b - 4.0 * a * c, 0.0))
    q = -0.5 * (b + jnp.where(b < 0.0, -1.0, 1.0) * sqrt_discriminant)
    tiny = 1e-300
    return q / jnp.where(jnp.abs(a) > tiny, a, tiny), c / jnp.where(jnp.abs(q) > tiny, q, tiny)
