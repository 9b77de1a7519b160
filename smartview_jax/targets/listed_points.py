"""Define targets whose points are listed, such as LEDs or the holes of a machined part."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .target import AbstractTarget


@dataclasses.dataclass(frozen=True)
class ListedPoints(AbstractTarget):
    """A target of points that were measured or made one by one.

    The package does not find them in pictures: a data set with such a target has a table of
    detected points.

    Attributes:
        coordinates: x, y and z of each point in the target's frame, m.
    """

    coordinates: Sequence[Sequence[float]]

    def __post_init__(self) -> None:
        """Raise a ValueError if the coordinates are not three finite numbers for each point."""
        try:
            points = np.array(self.coordinates, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"coordinates: expected numbers: {error}") from error
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise ValueError(
                f"coordinates: expected x, y, z (m) of each point, found shape {points.shape}"
            )
        wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(wrong):
            raise ValueError(f"coordinates: point {wrong[0]}: expected finite numbers")
        object.__setattr__(self, "coordinates", tuple(map(tuple, points.tolist())))

    @classmethod
    def of(cls, points: Float[np.ndarray, "points 3"]) -> "ListedPoints":
        """Return the target of an array of points `(points, 3)`, m.

        >>> sv.targets.ListedPoints.of(np.array([[0, 0, 0], [0.1, 0, 0]])).points[1]
        array([0.1, 0. , 0. ])
        """
        return cls(tuple(map(tuple, np.asarray(points, dtype=float).tolist())))

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The points as listed, m."""
        return np.array(self.coordinates)
