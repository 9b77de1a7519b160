"""Measure lengths and angles of an object with their standard deviations.

Errors common to all vertices, such as most of the calibration's error, cancel in a length. So
standard deviations come from the joint covariance of the vertices.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float


@runtime_checkable
class MeasuredPoints(Protocol):
    """Points with a joint covariance of any of them, such as triangulated or refined ones."""

    @property
    def points(self) -> Float[np.ndarray, "points 3"]: ...

    def joint_covariance(
        self, points: Sequence[int] | None = None
    ) -> Float[np.ndarray, "coordinates coordinates"]: ...


class Dimension(NamedTuple):
    """A measured number with its standard deviation.

    Attributes:
        value: m or rad.
        std: standard deviation due to all causes.
    """

    value: float
    std: float


def dimension(features: MeasuredPoints, first: int, second: int) -> Dimension:
    """Return the distance between two vertices, m, with its standard deviation.

    Raises:
        ValueError: a vertex that was not determined, equal vertices, or equal places.
    """
    (length,), gradient = pair_lengths(_determined(features, (first, second)), [[0, 1]])
    if not length > 0.0:
        raise ValueError(f"vertices {first} and {second} are in the same place: no direction")
    return Dimension(float(length), _std(features, (first, second), gradient[0]))


def pair_lengths(
    points: Float[np.ndarray, "points 3"], pairs: Sequence[Sequence[int]] | np.ndarray
) -> tuple[Float[np.ndarray, "pairs"], Float[np.ndarray, "pairs coordinates"]]:
    """Return the distances of pairs of points, and their derivatives by all coordinates.

    Points in one place have no direction, and derivatives of zero.
    """
    # d|b - a| = n . (db - da), with the unit vector n from a to b
    a, b = np.array(pairs).T
    differences = points[b] - points[a]
    lengths = np.linalg.norm(differences, axis=1)
    n = differences / np.maximum(lengths, 1e-30)[:, None]
    rows = np.arange(len(a))
    gradient = np.zeros((len(a), len(points), 3))
    gradient[rows, a], gradient[rows, b] = -n, n
    return lengths, gradient.reshape(len(a), -1)


def angle(features: MeasuredPoints, first: int, corner: int, second: int) -> Dimension:
    """Return the angle at a vertex between two others, rad, with its standard deviation.

    Raises:
        ValueError: as in `dimension`, or edges on one line, where the angle has no derivative.
    """
    a, c, b = _determined(features, (first, corner, second))
    # With the arctangent, an angle near 0 or 180 degrees keeps its digits.
    u, v = a - c, b - c
    normal = np.cross(u, v)
    sine = float(np.linalg.norm(normal))
    if not sine > 0.0:
        raise ValueError(f"vertices {first}, {corner} and {second} are on one line")
    # Each arm turns the angle by its displacement across the arm, in the plane, over its length.
    by_a = np.cross(u, normal / sine) / (u @ u)
    by_b = -np.cross(v, normal / sine) / (v @ v)
    gradient = np.concatenate([by_a, -by_a - by_b, by_b])
    return Dimension(
        float(np.arctan2(sine, u @ v)), _std(features, (first, corner, second), gradient)
    )


def _determined(features: MeasuredPoints, indices: tuple[int, ...]) -> Float[np.ndarray, "n 3"]:
    """Return some points; raise if one was not determined or is named twice."""
    if len(set(indices)) < len(indices):
        raise ValueError(f"expected different vertices, found {indices}")
    points = np.asarray(features.points)
    for k in indices:
        if not 0 <= k < len(points):
            raise ValueError(f"there is no vertex {k}, only {len(points)}")
        if not np.isfinite(points[k]).all():
            raise ValueError(f"vertex {k} was not determined: see `failures`")
    return points[list(indices)]


def _std(
    features: MeasuredPoints, indices: tuple[int, ...], gradient: Float[np.ndarray, "coordinates"]
) -> float:
    """Return the standard deviation of a number with a gradient by some points."""
    variance = gradient @ features.joint_covariance(indices) @ gradient
    # An exact constraint leaves a variance of rounding errors, of either sign.
    return float(np.sqrt(max(variance, 0.0)))
