"""Chessboards."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from .target import AbstractTarget, grid_points, grid_rotations, require_count, require_positive


@dataclasses.dataclass(frozen=True)
class Chessboard(AbstractTarget):
    """Inner corners, row by row.

    The square between the first four corners is a light one, if the colours allow it: turned so
    that it is, most boards have one order only.

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
        """The turns that put light squares on light ones.

        Half a turn moves the first square by `rows + columns - 4` squares, a quarter turn of a
        square board by `rows - 2`; an odd number changes its colour.
        """
        turns = (0, 1, 2, 3) if self.rows % 2 == 0 else (0, 2)
        if (self.rows + self.columns) % 2:
            turns = (0,)
        return grid_rotations(self.rows, self.columns, turns)
