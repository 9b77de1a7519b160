"""Find the poses, up to four, at which three points are seen along three rays.

Reference: Persson and Nordberg, Lambda Twist: an accurate fast robust perspective three point (P3P)
solver, 2018. All functions take many problems at once, as NumPy arrays.
"""

import numpy as np
from jaxtyping import Bool, Float

NEWTON_STEPS = 3
"""Number of Newton steps on the distances along the rays; each doubles the number of digits."""

MAX_DISTANCE_ERROR = 1e-6
"""Largest relative error of the squared distances between the points, in a solution."""


def three_point_poses(
    rays: Float[np.ndarray, "n 3 3"], points: Float[np.ndarray, "n 3 3"]
) -> tuple[Float[np.ndarray, "n 4 4 4"], Bool[np.ndarray, "n 4"]]:
    """Return the poses at which triples of points are seen along triples of rays.

    Args:
        rays: unit rays to the three points of each problem, in the camera's frame.
        points: in the object's frame, m, not on one line.

    Returns:
        camera_from_object, up to four for each problem, and a mask of the solutions; the others are
            NaN.
    """
    # Missing solutions are NaN or infinite, and are removed at the end.
    with np.errstate(all="ignore"):
        depths = _depths(rays, points)
        poses = _aligned(rays, points, depths)
        good = np.isfinite(poses).all(axis=(2, 3)) & (depths > 0.0).all(axis=2)
        good &= _distance_errors(rays, points, depths) < MAX_DISTANCE_ERROR
    return np.where(good[..., None, None], poses, np.nan), good


def _squared_distances(points: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return the squared distances of the pairs 12, 13 and 23 of three points."""
    pairs = points[..., (0, 0, 1), :] - points[..., (1, 2, 2), :]
    return (pairs**2).sum(axis=-1)


def _distance_errors(
    rays: Float[np.ndarray, "n 3 3"],
    points: Float[np.ndarray, "n 3 3"],
    depths: Float[np.ndarray, "n 4 3"],
) -> Float[np.ndarray, "n 4"]:
    """Return the largest relative error of the squared distances between points at given depths."""
    a = _squared_distances(points)[:, None]
    squared = _squared_distances(depths[..., None] * rays[:, None])
    return np.abs(squared - a).max(axis=-1) / a.max(axis=-1)


def _depths(
    rays: Float[np.ndarray, "n 3 3"], points: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 4 3"]:
    """Return the distances along the three rays, for up to four solutions."""
    # With the cosines b between rays and the squared distances a between points, the depths L obey
    #     L' M12 L = a12,  L' M13 L = a13,  L' M23 L = a23,   M12 = [[1, -b12, 0], [-b12, 1, 0], 0].
    # Eliminating the scale leaves two homogeneous quadratic forms, D1 and D2.
    a12, a13, a23 = (x[:, None, None] for x in _squared_distances(points).T)
    M12, M13, M23 = (_pair_form(rays, i, j) for i, j in ((0, 1), (0, 2), (1, 2)))
    D1, D2 = M12 * a23 - M23 * a12, M13 * a23 - M23 * a13
    gamma = _cubic_root(*_determinant_coefficients(D1, D2))[:, None, None]
    # A combination with zero determinant is a product of two planes through the origin.
    normals = _planes(D1 + gamma * D2)
    # On either plane D1 = -gamma D2; there this combination vanishes only at the solutions.
    D = gamma * D1 - D2
    solutions = [_on_plane(normal, D) for normal in normals]
    directions = np.concatenate(solutions, axis=1)
    # The scale comes from the sum of all sides; the sign makes the depths positive.
    forms = np.stack([M12, M13, M23], axis=1)
    values = np.einsum("nsi,nkij,nsj->nsk", directions, forms, directions)
    a = _squared_distances(points)[:, None]
    scale = np.sqrt(a.sum(axis=-1) / values.sum(axis=-1))
    depths = directions * (scale * np.sign(directions.sum(axis=-1)))[..., None]
    return _polished(depths, forms, a)


def _pair_form(rays: Float[np.ndarray, "n 3 3"], i: int, j: int) -> Float[np.ndarray, "n 3 3"]:
    """Return the quadratic form of the depths for the squared distance of points i and j."""
    form = np.zeros((len(rays), 3, 3))
    form[:, i, i] = form[:, j, j] = 1.0
    form[:, i, j] = form[:, j, i] = -(rays[:, i] * rays[:, j]).sum(axis=1)
    return form


def _determinant_coefficients(
    D1: Float[np.ndarray, "n 3 3"], D2: Float[np.ndarray, "n 3 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the coefficients of det(D1 + g D2) in g, the highest power first."""

    def triple(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
        return (first * np.cross(second, third)).sum(axis=1)

    p, q = (D.transpose(1, 0, 2) for D in (D1, D2))
    c3, c0 = triple(q[0], q[1], q[2]), triple(p[0], p[1], p[2])
    c2 = triple(p[0], q[1], q[2]) + triple(q[0], p[1], q[2]) + triple(q[0], q[1], p[2])
    c1 = triple(q[0], p[1], p[2]) + triple(p[0], q[1], p[2]) + triple(p[0], p[1], q[2])
    return c3, c2, c1, c0


def _cubic_root(
    c3: Float[np.ndarray, "n"],
    c2: Float[np.ndarray, "n"],
    c1: Float[np.ndarray, "n"],
    c0: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n"]:
    """Return one real root of each cubic; of three roots one with the steepest slope."""
    # x = y - c2 / (3 c3) gives y^3 + p y + q = 0.
    b, c, d = c2 / c3, c1 / c3, c0 / c3
    p, q = c - b**2 / 3.0, 2.0 * b**3 / 27.0 - b * c / 3.0 + d
    inner = (q / 2.0) ** 2 + (p / 3.0) ** 3
    # Cardano for one real root, in the form without cancellation.
    outer = np.cbrt(-q / 2.0 - np.where(q > 0.0, 1.0, -1.0) * np.sqrt(np.maximum(inner, 0.0)))
    single = outer - p / (3.0 * outer)
    # Three real roots: 2 r cos(theta + 2 pi k / 3); the outer ones are the steepest.
    r = np.sqrt(np.maximum(-p / 3.0, 0.0))
    theta = np.arccos(np.clip(-q / (2.0 * r**3), -1.0, 1.0)) / 3.0
    triple = np.where(q > 0.0, 2.0 * r * np.cos(theta + 2.0 * np.pi / 3.0), 2.0 * r * np.cos(theta))
    x = np.where(inner > 0.0, single, triple) - b / 3.0
    for _ in range(2):
        x = x - (((x + b) * x + c) * x + d) / ((3.0 * x + 2.0 * b) * x + c)
    return x


def _planes(D0: Float[np.ndarray, "n 3 3"]) -> list[Float[np.ndarray, "n 3"]]:
    """Return the normals of the two planes on which a form of determinant zero vanishes."""
    # Its other two eigenvalues are the roots of s^2 - trace s + (sum of the principal minors).
    trace = np.trace(D0, axis1=1, axis2=2)
    minors = 0.5 * (trace**2 - (D0**2).sum(axis=(1, 2)))
    root = np.sqrt(np.maximum(0.25 * trace**2 - minors, 0.0))
    high, low = 0.5 * trace + root, 0.5 * trace - root
    e1, e2 = _eigenvector(D0, high), _eigenvector(D0, low)
    # high (e1 . L)^2 + low (e2 . L)^2 = 0 with low < 0:  e1 . L = +-s e2 . L.
    s = np.sqrt(-low / high)[:, None]
    return [e1 - s * e2, e1 + s * e2]


def _eigenvector(
    matrix: Float[np.ndarray, "n 3 3"], value: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the unit eigenvectors of symmetric matrices for simple eigenvalues."""
    # They are perpendicular to all rows of matrix - value I; at least two rows are not parallel.
    rows = matrix - value[:, None, None] * np.eye(3)
    crossed = np.cross(rows[:, (0, 0, 1)], rows[:, (1, 2, 2)])
    longest = np.argmax((crossed**2).sum(axis=2), axis=1)
    vectors = crossed[np.arange(len(rows)), longest]
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _on_plane(
    normal: Float[np.ndarray, "n 3"], D: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 2 3"]:
    """Return the two directions in a plane for which a quadratic form vanishes."""
    # L = u + tau v, where u and v span the plane; u starts from the axis least along the normal.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    u = np.cross(normal, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    # tau^2 v'Dv + 2 tau u'Dv + u'Du = 0
    A, B, C = (np.einsum("ni,nij,nj->n", x, D, y) for x, y in ((v, v), (u, v), (u, u)))
    root = np.sqrt(B**2 - A * C)
    # The larger root, and the other one from the product of both, without cancellation.
    large = -(B + np.where(B > 0.0, root, -root))
    return np.stack(
        [A[:, None] * u + large[:, None] * v, large[:, None] * u + C[:, None] * v], axis=1
    )


def _polished(
    depths: Float[np.ndarray, "n 4 3"],
    forms: Float[np.ndarray, "n 3 3 3"],
    squared_distances: Float[np.ndarray, "n 1 3"],
) -> Float[np.ndarray, "n 4 3"]:
    """Return depths after a few Newton steps on the three squared distances."""
    for _ in range(NEWTON_STEPS):
        half_slopes = np.einsum("nkij,nsj->nski", forms, depths)
        error = np.einsum("nski,nsi->nsk", half_slopes, depths) - squared_distances
        depths = depths - 0.5 * _solved(half_slopes, error)
    return depths


def _solved(
    matrices: Float[np.ndarray, "n 4 3 3"], right: Float[np.ndarray, "n 4 3"]
) -> Float[np.ndarray, "n 4 3"]:
    """Return the solutions of systems of three equations; infinite where singular."""
    # By Cramer's rule: LAPACK would fail on all for one singular system, and is slower.
    a, b, c = (matrices[..., k] for k in range(3))
    across = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
    determinant = (a * across[..., 0, :]).sum(axis=-1)
    return (across @ right[..., None])[..., 0] / determinant[..., None]


def _aligned(
    rays: Float[np.ndarray, "n 3 3"],
    points: Float[np.ndarray, "n 3 3"],
    depths: Float[np.ndarray, "n 4 3"],
) -> Float[np.ndarray, "n 4 4 4"]:
    """Return the poses that move the points to given depths along the rays."""
    target = depths[..., None] * rays[:, None]
    source = _frames(points)[:, None]
    rotations = _frames(target) @ np.swapaxes(source, -1, -2)
    poses = np.zeros((*depths.shape[:2], 4, 4))
    poses[..., :3, :3] = rotations
    # The first point goes to its place on the ray: t = L1 y1 - R x1.
    poses[..., :3, 3] = target[..., 0, :] - (rotations @ points[:, None, 0, :, None])[..., 0]
    poses[..., 3, 3] = 1.0
    return poses


def _frames(points: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return right-handed frames, as columns: x along the first side, z normal to all points."""
    first, second = points[..., 1, :] - points[..., 0, :], points[..., 2, :] - points[..., 0, :]
    x = first / np.linalg.norm(first, axis=-1, keepdims=True)
    z = np.cross(first, second)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
