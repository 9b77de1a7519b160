"""Grids of circles."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from .target import (
    AbstractTarget,
    grid_points,
    grid_rotations,
    require_count,
    require_flag,
    require_positive,
)


@dataclasses.dataclass(frozen=True)
class CircleGrid(AbstractTarget):
    """Circle centres, row by row.

    Attributes:
        rows, columns: number of circles down and across; for an asymmetric grid as OpenCV counts
            them, every second row being shifted by half a step.
        spacing: between neighbours in a row, m; for an asymmetric grid half of that, which is also
            the distance between rows (OpenCV's convention).
        asymmetric: every second row shifted.
        light_on_dark: white circles on black.
        origin_mark: one larger corner circle marks the origin (the "modified" grid).
        radius: of the circles, where known, m.
        mark_radius: of the circle that marks the origin, where known, m.
    """

    rows: int
    columns: int
    spacing: float
    asymmetric: bool = False
    light_on_dark: bool = False
    origin_mark: bool = False
    radius: float | None = None
    mark_radius: float | None = None

    def __post_init__(self):
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
        known = {"radius": self.radius, "mark_radius": self.mark_radius}
        require_positive(**{name: value for name, value in known.items() if value is not None})
        if self.radius is not None and self.radius >= 0.5 * self.nearest:
            raise ValueError(f"radius: circles {self.nearest:g} m apart would touch")

    @property
    def nearest(self) -> float:
        """Distance between neighbouring centres, m."""
        return self.spacing * (2.0**0.5 if self.asymmetric else 1.0)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        if not self.asymmetric:
            return grid_points(self.rows, self.columns, self.spacing)
        i, j = np.mgrid[0 : self.rows, 0 : self.columns]
        flat = np.stack([(2 * j + i % 2), i, np.zeros_like(i)], axis=-1)
        return self.spacing * flat.reshape(-1, 3).astype(float)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        if self.origin_mark:
            return np.arange(self.rows * self.columns)[None]
        if self.asymmetric:
            # With an even number of rows half a turn maps shifted rows to unshifted ones.
            index = np.arange(self.rows * self.columns)
            return index[None] if self.rows % 2 else np.stack([index, index[::-1]])
        return grid_rotations(self.rows, self.columns)
