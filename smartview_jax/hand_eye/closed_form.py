"""Solve the hand-eye problem in closed form, as starts for Step 3 and as a check on it.

Every method takes the chain (Eq. 10)

    camera_from_world_i = camera_from_mount @ mount_from_holder_i @ holder_from_world

and returns both unknowns, `(camera_from_mount, holder_from_world)`. For a camera on the hand the
mount is the tool and the holder is the base. OpenCV is not used: its version 5 no longer has these
functions in its Python package. A view of weight zero does not affect the result. Everything runs
once on small arrays, in NumPy; the returned transforms hold NumPy arrays. They are NaN if a pose is
not finite, and may be for motions that do not determine them.
"""

import functools
from collections.abc import Callable

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from ..geometry import (
    host_cross_matrices,
    host_matrices,
    host_nearest_rotation,
    host_poses,
    host_rotation_vectors,
    host_transforms,
    mean_matrix,
    quaternion_product,
)

_Matrix = Float[np.ndarray, "4 4"]
_Batch = Float[np.ndarray, "*batch 4 4"]
_BatchOfViews = Float[np.ndarray, "*batch views 4 4"]
_Matrices = Float[np.ndarray, "views 4 4"]
_Weights = Float[np.ndarray, "views"]

MAX_PAIRS = 1000
"""Largest number of pairs of views up to which all pairs are used; 45 views have that many.

More motions hardly improve a closed form, and their number would grow with the square of the
views."""

MIN_PAIRS_PER_VIEW, CANDIDATES_PER_PAIR = 4, 3
"""Smallest number of pairs chosen for each view of many, and of candidates for each of them."""


class ClosedForm:
    """A method that computes both transforms from the poses of robot and camera, without a start.

    It is a function of `mount_from_holder`, `camera_from_world` and the weights of the views, and
    returns `camera_from_mount` and `holder_from_world`.
    """

    def __init__(self, solve: Callable[[_Matrices, _Matrices, _Weights], tuple[_Matrix, _Matrix]]):
        self._solve = solve
        functools.update_wrapper(self, solve, ("__module__", "__name__", "__qualname__", "__doc__"))
        # Documentation shows the signature for transforms, not the one for matrices.
        del vars(self)["__wrapped__"]

    def __reduce__(self) -> str:
        # Pickled by name, as functions are, so that other processes can be given it.
        return self._solve.__name__

    def __call__(
        self,
        mount_from_holder: SE3,
        camera_from_world: SE3,
        weights: Float[Array, "views"] | Float[np.ndarray, "views"],
    ) -> tuple[SE3, SE3]:
        """Return both transforms, NaN where poses with weight are not finite."""
        camera_from_mount, holder_from_world = self.of_matrices(
            host_matrices(mount_from_holder), host_matrices(camera_from_world), np.asarray(weights)
        )
        return host_transforms(camera_from_mount), host_transforms(holder_from_world)

    def of_matrices(
        self, mount_from_holder: _Matrices, camera_from_world: _Matrices, weights: _Weights
    ) -> tuple[_Matrix, _Matrix]:
        """Return both transforms as matrices, of poses that are matrices; see `__call__`."""
        used = weights > 0.0
        M, C = mount_from_holder[used], camera_from_world[used]
        if not (np.isfinite(M).all() and np.isfinite(C).all()):
            missing = np.full((4, 4), np.nan)
            return missing, missing
        # Motions that do not determine the transforms may divide by zero; the result shows it.
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return self._solve(M, C, weights[used])


def mean_holder_from_world(
    camera_from_mount: _Batch,
    mount_from_holder: _BatchOfViews,
    camera_from_world: _BatchOfViews,
    weights: _Weights,
) -> _Batch:
    """Compute `holder_from_world` for a given `camera_from_mount`, averaged over the views."""
    # Eq. 10 for one view: holder_from_world = (camera_from_mount mount_from_holder)^-1
    # camera_from_world.
    camera_from_holder = camera_from_mount[..., None, :, :] @ mount_from_holder
    return mean_matrix(np.linalg.inv(camera_from_holder) @ camera_from_world, weights)


def mean_camera_from_mount(
    holder_from_world: Float[np.ndarray, "*starts 4 4"],
    mount_from_holder: _BatchOfViews,
    camera_from_world: _BatchOfViews,
    weights: _Weights,
) -> Float[np.ndarray, "*starts 4 4"]:
    """Compute `camera_from_mount` for a given `holder_from_world`, averaged over the views.

    The errors of the two then cancel in the chain.
    """
    # Eq. 10 for one view: camera_from_mount = camera_from_world (mount_from_holder
    # holder_from_world)^-1.
    mount_from_world = mount_from_holder @ holder_from_world[..., None, :, :]
    return mean_matrix(camera_from_world @ np.linalg.inv(mount_from_world), weights)


def motion_pairs(
    mount_from_holder: _BatchOfViews, camera_from_world: _BatchOfViews, weights: _Weights
) -> tuple[
    Float[np.ndarray, "*batch pairs 4 4"],
    Float[np.ndarray, "*batch pairs 4 4"],
    Float[np.ndarray, "pairs"],
]:
    """Return A, B and weights of `A X = X B` for pairs of different views, each pair once.

    `A = C_j C_i^-1` and `B = T_j T_i^-1` with `X = camera_from_mount`: Eq. 10 for two views with
    `holder_from_world` eliminated. The motion from j to i is the inverse, which says the same. A
    batch has the same pairs everywhere; its views are few (`MAX_PAIRS`).
    """
    first, second = _paired_views(mount_from_holder[..., :3, :3], camera_from_world[..., :3, :3])

    def relative_poses(poses: _BatchOfViews) -> Float[np.ndarray, "*batch pairs 4 4"]:
        """Return the motions `P_j P_i^-1` of all pairs."""
        return poses[..., second, :, :] @ np.linalg.inv(poses)[..., first, :, :]

    return (
        relative_poses(camera_from_world),
        relative_poses(mount_from_holder),
        weights[first] * weights[second],
    )


def _paired_views(
    robot: Float[np.ndarray, "*batch views 3 3"], camera: Float[np.ndarray, "*batch views 3 3"]
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """Return the indices of the views of every pair: all pairs, or well-spread ones of many views.

    The number of chosen pairs grows with the views, not with their square. They are chosen by the
    motions, so that many views cannot come as a batch.
    """
    views = robot.shape[-3]
    if views * (views - 1) // 2 <= MAX_PAIRS:
        return np.triu_indices(views, 1)
    # Candidates: the views form a ring, and each is paired with views at distances spread over
    # half of it, so that no pair comes twice and neighbours in time do not prevail.
    count = max(MIN_PAIRS_PER_VIEW, -(-MAX_PAIRS // views))
    spread = np.linspace(1, (views - 1) // 2, CANDIDATES_PER_PAIR * count)
    distances = np.unique(spread.round().astype(int))
    indices = np.arange(views)
    partners = (indices[:, None] + distances) % views
    # A turn by a small angle has an uncertain axis, a turn by about 180 degrees an axis of
    # uncertain sign. The best pairs have the largest sine, by 2 cos(angle) + 1 = trace(R_j R_i^T).
    traces = [np.einsum("nab,nkab->nk", R, R[partners]) for R in (robot, camera)]
    squared_sine = np.min([1.0 - np.square(0.5 * (trace - 1.0)) for trace in traces], axis=0)
    best = np.argsort(-squared_sine, axis=1, kind="stable")[:, :count]
    return np.repeat(indices, best.shape[1]), np.take_along_axis(partners, best, axis=1).ravel()


def park_martin_matrices(
    mount_from_holder: _BatchOfViews, camera_from_world: _BatchOfViews, weights: _Weights
) -> tuple[_Batch, _Batch]:
    """Compute both transforms as `park_martin` does, from finite matrices.

    Each set of views of a batch has at most `MAX_PAIRS` pairs.
    """
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    # sum w a b^T, with the rotation vectors a and b of each pair in the rows of two matrices.
    a, b = host_rotation_vectors(A), host_rotation_vectors(B)
    rotation = host_nearest_rotation((w[:, None] * a).swapaxes(-1, -2) @ b)
    return _solve_translation(rotation, A, B, w, mount_from_holder, camera_from_world, weights)


@ClosedForm
def park_martin(
    mount_from_holder: _Matrices, camera_from_world: _Matrices, weights: _Weights
) -> tuple[_Matrix, _Matrix]:
    """Compute the rotation from rotation vectors, then the translation (Park and Martin, 1994).

    `R_A R = R R_B` means that R maps the rotation vectors b of B to the rotation vectors a of A: R
    is the rotation nearest to `sum w a b^T`.
    """
    return park_martin_matrices(mount_from_holder, camera_from_world, weights)


@ClosedForm
def tsai_lenz(
    mount_from_holder: _Matrices, camera_from_world: _Matrices, weights: _Weights
) -> tuple[_Matrix, _Matrix]:
    """Compute the rotation from modified Rodrigues vectors, then the translation.

    With `a, b = 2 sin(angle / 2) axis` of A and B, `skew(a + b) p' = b - a` is solved for
    `p' = tan(angle / 2) axis` of X, and `p = 2 p' / sqrt(1 + |p'|^2)` gives

        R = (1 - |p|^2 / 2) I + (p p^T + sqrt(4 - |p|^2) skew(p)) / 2

    Reference: Tsai and Lenz, 1989.
    """
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    a, b = (2.0 * _quaternions(motions)[:, 1:] for motions in (A, B))
    # Least squares for p' = tan(angle / 2) axis, the Rodrigues (Gibbs) vector of X.
    skew = (w[:, None, None] * host_cross_matrices(a + b)).reshape(-1, 3)
    rodrigues = np.linalg.lstsq(skew, (w[:, None] * (b - a)).reshape(-1))[0]
    # p = 2 sin(angle / 2) axis, since sin = tan / sqrt(1 + tan^2).
    p = 2.0 * rodrigues / np.sqrt(1.0 + np.sum(rodrigues**2))
    square = np.sum(p**2)
    rotation = (1.0 - 0.5 * square) * np.eye(3) + 0.5 * (
        np.outer(p, p) + np.sqrt(max(4.0 - square, 0.0)) * host_cross_matrices(p)
    )
    return _solve_translation(
        host_nearest_rotation(rotation), A, B, w, mount_from_holder, camera_from_world, weights
    )


@ClosedForm
def daniilidis(
    mount_from_holder: _Matrices, camera_from_world: _Matrices, weights: _Weights
) -> tuple[_Matrix, _Matrix]:
    """Compute rotation and translation together by dual quaternions (Daniilidis, 1999).

    `a q = q b` for dual quaternions is linear in the eight numbers `(q, q')` of X. The null space
    has two dimensions, and the constraints `|q| = 1`, `q . q' = 0` select the solution in it.
    """
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    (a, a_dual), (b, b_dual) = _dual_quaternion(A), _dual_quaternion(B)
    # a q - q b = 0 in real and dual parts (scalar rows dropped, they are equal for exact data):
    #     [a - b    skew(a + b)     0       0        ]   [q ]
    #     [a' - b'  skew(a' + b')   a - b   skew(a + b)] [q'] = 0
    real_rows = np.concatenate([(a - b)[:, 1:, None], host_cross_matrices((a + b)[:, 1:])], axis=2)
    dual_rows = np.concatenate(
        [(a_dual - b_dual)[:, 1:, None], host_cross_matrices((a_dual + b_dual)[:, 1:])], axis=2
    )
    rows = np.block([[real_rows, np.zeros_like(real_rows)], [dual_rows, real_rows]])
    # The eigenvectors of the two smallest eigenvalues span the null space.
    rows = (w[:, None, None] * rows).reshape(-1, 8)
    _, vectors = np.linalg.eigh(rows.T @ rows)
    v, u = vectors[:, 0], vectors[:, 1]
    # The solution is x v + y u = y (s v + u) with q . q' = 0, quadratic in s = x / y, and with a
    # unit real part. Of its two roots the one with the longer real part is right.
    s = _quadratic_roots(
        float(v[:4] @ v[4:]), float(v[:4] @ u[4:] + u[:4] @ v[4:]), float(u[:4] @ u[4:])
    )
    candidates = s[:, None] * v + u
    q, q_dual = candidates[np.argmax(np.linalg.norm(candidates[:, :4], axis=1))].reshape(2, 4)
    length = np.linalg.norm(q)
    q, q_dual = q / length, q_dual / length
    # The dual part is q' = t q / 2, so the translation is the vector part of 2 q' q^-1.
    translation = 2.0 * quaternion_product(q_dual, q * [1.0, -1.0, -1.0, -1.0])[1:]
    numbers = np.concatenate([q, translation])
    camera_from_mount = host_matrices(SE3(numbers))  # pyright: ignore[reportArgumentType]
    return camera_from_mount, mean_holder_from_world(
        camera_from_mount, mount_from_holder, camera_from_world, weights
    )


@ClosedForm
def shah(
    mount_from_holder: _Matrices, camera_from_world: _Matrices, weights: _Weights
) -> tuple[_Matrix, _Matrix]:
    """Compute both transforms of `A X = Z B` by a Kronecker product (Shah, 2013).

    The first singular pair of `sum w kron(M_i, C_i)` is vec(R_world) and vec(R_camera). The
    translations then follow from the linear equations
    `R_camera M_i t_world + t_camera = t_C_i - R_camera t_M_i`.
    """
    M, C = mount_from_holder[:, :3, :3], camera_from_world[:, :3, :3]
    # The rotations of Eq. 10, C_i = R_camera M_i R_world, give C_i R_world^T M_i^T = R_camera in
    # every view.
    K = np.einsum("i,iab,icd->acbd", weights, M, C).reshape(9, 9)
    U, _, Vt = np.linalg.svd(K)
    camera, world = U[:, 0].reshape(3, 3).T, Vt[0].reshape(3, 3).T
    # The sign of a pair of singular vectors is arbitrary; both matrices must be proper rotations.
    sign = -1.0 if np.linalg.det(camera) < 0.0 else 1.0
    R_camera = host_nearest_rotation(sign * camera)
    R_world = host_nearest_rotation(sign * world * np.sign(np.linalg.det(sign * world))).T
    # With both rotations known, [R_camera M_i, I] [t_world; t_camera] = t_C_i - R_camera t_M_i.
    matrix = np.concatenate([R_camera @ M, np.broadcast_to(np.eye(3), M.shape)], axis=2)
    matrix = (weights[:, None, None] * matrix).reshape(-1, 6)
    rotated_translation = mount_from_holder[:, :3, 3] @ R_camera.T
    right_hand_side = (
        weights[:, None] * (camera_from_world[:, :3, 3] - rotated_translation)
    ).reshape(-1)
    solution = np.linalg.lstsq(matrix, right_hand_side)[0]
    return host_poses(R_camera, solution[3:]), host_poses(R_world, solution[:3])


CLOSED_FORMS: dict[str, ClosedForm] = {
    "Park-Martin": park_martin,
    "Tsai-Lenz": tsai_lenz,
    "Daniilidis": daniilidis,
    "Shah": shah,
}
"""The closed forms, by the names under which they are reported."""


def _solve_translation(
    rotation: Float[np.ndarray, "*batch 3 3"],
    A: Float[np.ndarray, "*batch pairs 4 4"],
    B: Float[np.ndarray, "*batch pairs 4 4"],
    w: Float[np.ndarray, "pairs"],
    mount_from_holder: _BatchOfViews,
    camera_from_world: _BatchOfViews,
    weights: _Weights,
) -> tuple[_Batch, _Batch]:
    """Solve `(R_A - I) t = R t_B - t_A` by least squares, and return both transforms."""
    # From A X = X B: R_A t + t_A = R t_B + t.
    batch, rows = rotation.shape[:-2], 3 * len(w)
    matrix = (w[:, None, None] * (A[..., :3, :3] - np.eye(3))).reshape(*batch, rows, 3)
    moved = B[..., :3, 3] @ rotation.swapaxes(-1, -2) - A[..., :3, 3]
    right_hand_side = (w[:, None] * moved).reshape(*batch, rows, 1)
    # As `np.linalg.lstsq` solves it, which takes no batch.
    inverse = np.linalg.pinv(matrix, rcond=max(rows, 3) * np.finfo(float).eps)
    camera_from_mount = host_poses(rotation, (inverse @ right_hand_side)[..., 0])
    return camera_from_mount, mean_holder_from_world(
        camera_from_mount, mount_from_holder, camera_from_world, weights
    )


def _quaternions(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4"]:
    """Return the rotations of poses as unit quaternions with a positive scalar part, first."""
    # q and -q are the same rotation; the one with a positive scalar part has angles up to pi.
    # SciPy puts the scalar part last.
    return Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]


def _dual_quaternion(
    poses: Float[np.ndarray, "n 4 4"],
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
    """Return real part q and dual part `t q / 2` of the unit dual quaternions of poses."""
    q = _quaternions(poses)
    t = np.pad(poses[:, :3, 3], ((0, 0), (1, 0)))
    return q, 0.5 * np.asarray(quaternion_product(t, q))


def _quadratic_roots(a: float, b: float, c: float) -> Float[np.ndarray, "2"]:
    """Return both roots of `a s^2 + b s + c = 0`, without cancellation."""
    # q = -(b + sign(b) sqrt_discriminant) / 2 adds numbers of equal sign; the roots are q / a and
    # c / q.
    sqrt_discriminant = np.sqrt(max(b * b - 4.0 * a * c, 0.0))
    q = -0.5 * (b + (-1.0 if b < 0.0 else 1.0) * sqrt_discriminant)
    tiny = 1e-300
    return np.array([q / (a if abs(a) > tiny else tiny), c / (q if abs(q) > tiny else tiny)])
