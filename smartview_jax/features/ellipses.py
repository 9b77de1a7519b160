"""Find ellipses among the edge points of a picture: round rims, seen at an angle.

Connected edge points often hold more than a rim: the side of a pipe continues its rim without a
corner. So each chain is searched for the ellipse that most of its points lie on (Fischler and
Bolles, "Random sample consensus", 1981), from three points with their tangents at a time, and once
more for what remains.
"""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree


@dataclasses.dataclass(frozen=True)
class EllipseOptions:
    """The limits of an ellipse among edge points, and of the search for it.

    Attributes:
        min_points: smallest number of edge points of an ellipse, and so of a chain that is
            searched.
        max_chains: number of the longest chains that are searched.
        per_chain: number of ellipses that each may hold.
        max_gap: largest distance of neighbours in a chain, px.
        min_cosine: smallest cosine between their normals.
        trials: number of triples tried in a chain; one in eight is good where half of the points
            are.
        near: largest distance of a point from its ellipse, px.
        aligned: smallest cosine between their normals.
        min_seen: smallest share of an ellipse's directions in which it has edge points.
        min_axis: smallest half axis, px.
    """

    min_points: int = 24
    max_chains: int = 60
    per_chain: int = 3
    max_gap: float = 1.8
    min_cosine: float = 0.9
    trials: int = 128
    near: float = 1.0
    aligned: float = 0.97
    min_seen: float = 0.3
    min_axis: float = 4.0


DEFAULT_OPTIONS = EllipseOptions()
"""The default options."""


def find_ellipses(
    points: Float[np.ndarray, "points 2"],
    normals: Float[np.ndarray, "points 2"],
    options: EllipseOptions = DEFAULT_OPTIONS,
) -> Float[np.ndarray, "ellipses 3 3"]:
    """Return the conics `p^T Q p = 0` of ellipses with edge points, those with the most first.

    Args:
        points: edge points in the ideal plane (`IdealPlane`), px; NaN outside the lens's field.
        normals: directions of their gradients.
    """
    usable = np.isfinite(points).all(axis=1)
    points, normals = points[usable], normals[usable]
    if len(points) < options.min_points:
        return np.zeros((0, 3, 3))
    ellipses, rng = [], np.random.default_rng(0)
    for chain in _chains(points, normals, options):
        remaining = chain
        for _ in range(options.per_chain):
            if len(remaining) < options.min_points:
                break
            conic = _best_of_trials(points[remaining], normals[remaining], options, rng)
            if conic is None:
                break
            conic, on = _refined(conic, points, normals, options)
            if conic is None:
                break
            if _seen_share(conic, points[on]) >= options.min_seen:
                ellipses.append((int(on.sum()), conic))
            remaining = remaining[~on[remaining]]
    ellipses.sort(key=lambda entry: -entry[0])
    return np.array([conic for _, conic in ellipses]).reshape(-1, 3, 3)


def _chains(
    points: Float[np.ndarray, "points 2"],
    normals: Float[np.ndarray, "points 2"],
    options: EllipseOptions,
) -> list[np.ndarray]:
    """Return the indices of the points of the longest chains, the longest first."""
    a, b = KDTree(points).query_pairs(options.max_gap, output_type="ndarray").T
    joined = (normals[a] * normals[b]).sum(axis=1) > options.min_cosine
    a, b = a[joined], b[joined]
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(points),) * 2)
    label = connected_components(graph, directed=False)[1]
    sizes = np.bincount(label)
    largest = np.argsort(-sizes, kind="stable")[: options.max_chains]
    return [np.flatnonzero(label == k) for k in largest if sizes[k] >= options.min_points]


def _best_of_trials(
    points: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"],
    options: EllipseOptions,
    rng: np.random.Generator,
) -> Float[np.ndarray, "3 3"] | None:
    """Return the ellipse through three points with their tangents that has most points."""
    middle, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    p, triples = (points - middle) / size, rng.integers(len(points), size=(options.trials, 3))
    x, y = np.moveaxis(p[triples], -1, 0)
    dx, dy = np.moveaxis(normals[triples] @ np.array([[0.0, 1.0], [-1.0, 0.0]]), -1, 0)
    one, zero = np.ones_like(x), np.zeros_like(x)
    # A x^2 + B xy + C y^2 + D x + E y + F = 0, and its derivative along the tangent.
    on = np.stack([x * x, x * y, y * y, x, y, one], axis=-1)
    along = np.stack([2 * x * dx, x * dy + y * dx, 2 * y * dy, dx, dy, zero], axis=-1)
    A, B, C, D, E, F = np.linalg.svd(np.concatenate([on, along], axis=1))[2][:, -1].T
    conics = np.stack([A, B / 2, D / 2, B / 2, C, E / 2, D / 2, E / 2, F], axis=-1)
    conics = conics.reshape(-1, 3, 3)[4.0 * A * C > B * B]
    if not len(conics):
        return None
    near, aligned = options.near / size, options.aligned
    counts = [_on_ellipse(conic, p, normals, near, aligned).sum() for conic in conics]
    to_unit = np.diag([1.0 / size, 1.0 / size, 1.0])
    to_unit[:2, 2] = -middle / size
    return to_unit.T @ conics[int(np.argmax(counts))] @ to_unit


def _on_ellipse(
    conic: Float[np.ndarray, "3 3"],
    points: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"],
    near: float,
    aligned: float,
) -> Bool[np.ndarray, "n"]:
    """Return which points are on an ellipse that is darker, or lighter, inside all along it."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ conic
    value = (homogeneous[:, :2] * points).sum(axis=1) + homogeneous[:, 2]
    size = np.maximum(np.linalg.norm(homogeneous[:, :2], axis=1), 1e-12)
    cosine = (homogeneous[:, :2] * normals).sum(axis=1) / size
    # Sampson's distance: the value over its gradient, which is twice `homogeneous`.
    is_near = np.abs(value) < 2.0 * near * size
    return max((is_near & (sign * cosine > aligned) for sign in (-1.0, 1.0)), key=np.sum)


def _refined(
    conic: Float[np.ndarray, "3 3"],
    points: Float[np.ndarray, "n 2"],
    normals: Float[np.ndarray, "n 2"],
    options: EllipseOptions,
) -> tuple[Float[np.ndarray, "3 3"] | None, Bool[np.ndarray, "n"]]:
    """Return the ellipse fitted to all points near it, and which these are; None for too few."""
    on = np.zeros(len(points), bool)
    for near in (2.0 * options.near, options.near):
        on = _on_ellipse(conic, points, normals, near, options.aligned)
        if on.sum() < options.min_points:
            return None, on
        (u, v), (width, height), degrees = cv2.fitEllipseDirect(points[on].astype(np.float32))
        half = 0.5 * np.array([width, height])
        if not np.isfinite([u, v, *half]).all() or half.min() < options.min_axis:
            return None, on
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        to_unit = np.eye(3)
        to_unit[:2, :2] = np.array([[c, s], [-s, c]]) / half[:, None]
        to_unit[:2, 2] = -to_unit[:2, :2] @ [u, v]
        conic = to_unit.T @ np.diag([1.0, 1.0, -1.0]) @ to_unit
    return conic, _on_ellipse(conic, points, normals, options.near, options.aligned)


def _seen_share(conic: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "n 2"]) -> float:
    """Return the share of the directions from an ellipse's middle in which it has points."""
    middle = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    # Directions in the frame in which the ellipse is a circle.
    turned = (points - middle) @ np.linalg.cholesky(conic[:2, :2] * np.sign(conic[0, 0]))
    sectors = np.floor(np.arctan2(turned[:, 1], turned[:, 0]) / (2.0 * np.pi) * 36.0).astype(int)
    return len(np.unique(sectors % 36)) / 36.0
