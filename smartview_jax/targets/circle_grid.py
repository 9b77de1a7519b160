"""Define targets that are grids of circles."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from .target import (
    AbstractTarget,
    grid_points,
    grid_symmetries,
    require_count,
    require_flag,
    require_positive,
)


@dataclasses.dataclass(frozen=True)
class CircleGrid(AbstractTarget):
    """A grid of circles whose points are the circle centres, row by row.

    Attributes:
        rows, columns: number of circles down and across; for an asymmetric grid as OpenCV counts
            them, with every second row shifted by half the distance in a row.
        spacing: distance between neighbours in a row, m; for an asymmetric grid half of this
            distance, which is also the distance between rows (OpenCV's convention).
        asymmetric: whether every second row is shifted.
        light_on_dark: whether the circles are white on black.
        origin_mark: whether one larger corner circle marks the origin (the "modified" grid).
        radius: radius of the circles, m; None if unknown.
        mark_radius: radius of the circle that marks the origin, m; None if unknown.
    """

    rows: int
    columns: int
    spacing: float
    asymmetric: bool = False
    light_on_dark: bool = False
    origin_mark: bool = False
    radius: float | None = None
    mark_radius: float | None = None

    lengths: ClassVar[tuple[str, ...]] = ("spacing", "radius", "mark_radius")

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(2, rows=self.rows, columns=self.columns)
        require_positive(spacing=self.spacing)
        require_flag(
            asymmetric=self.asymmetric,
            light_on_dark=self.light_on_dark,
            origin_mark=self.origin_mark,
        )
        if self.asymmetric and self.origin_mark:
            raise ValueError("origin_mark: only a symmetric grid has a larger corner circle")
        if self.mark_radius is not None and not self.origin_mark:
            raise ValueError("mark_radius: this grid has no origin_mark")
        # A radius is optional: only the correction of circle centres needs it.
        known = {"radius": self.radius, "mark_radius": self.mark_radius}
        require_positive(**{name: value for name, value in known.items() if value is not None})
        if self.radius is not None and self.radius >= 0.5 * self.nearest_neighbour_distance:
            raise ValueError(
                f"radius: circles {self.nearest_neighbour_distance:g} m apart would touch"
            )

    @property
    def has_known_radii(self) -> bool:
        """Whether the radius of every circle is stated."""
        return self.radius is not None and (self.mark_radius is not None or not self.origin_mark)

    @property
    def nearest_neighbour_distance(self) -> float:
        """The distance between neighbouring centres, m."""
        # In an asymmetric grid the nearest centre is one spacing away in x and in y.
        return self.spacing * (2.0**0.5 if self.asymmetric else 1.0)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The circle centres, row by row, m."""
        if not self.asymmetric:
            return grid_points(self.rows, self.columns, self.spacing)
        # Circle j of row i is at (2 j + i mod 2, i), in units of the spacing.
        i, j = np.mgrid[0 : self.rows, 0 : self.columns]
        flat = np.stack([(2 * j + i % 2), i, np.zeros_like(i)], axis=-1)
        return self.spacing * flat.reshape(-1, 3).astype(float)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """The orders of the circles that look the same, the original order first."""
        if self.origin_mark:
            return np.arange(self.rows * self.columns)[None]
        if self.asymmetric:
            # Rotating by 180 degrees maps x to 2 columns - 1 - x and row i to rows - 1 - i. With an
            # even number of rows this exchanges shifted and unshifted rows, and the pattern is the
            # same; with an odd number it is not.
            index = np.arange(self.rows * self.columns)
            return index[None] if self.rows % 2 else np.stack([index, index[::-1]])
        return grid_symmetries(self.rows, self.columns)
