"""Chessboards."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from .target import AbstractTarget, grid_points, grid_rotations, require_count, require_positive


@dataclasses.dataclass(frozen=True)
class Chessboard(AbstractTarget):
    """Inner corners, row by row.

    Attributes:
        rows, columns: number of inner corners down and across.
        square: side of a square, m.
    """

    rows: int
    columns: int
    square: float

    def __post_init__(self):
        require_count(2, rows=self.rows, columns=self.columns)
        require_positive(square=self.square)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        return grid_points(self.rows, self.columns, self.square)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """Half a turn; detectors do not all look at the colours that could tell more."""
        return grid_rotations(self.rows, self.columns)
