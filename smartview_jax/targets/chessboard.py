"""Define chessboard targets."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from .target import AbstractTarget, grid_points, grid_symmetries, require_count, require_positive


@dataclasses.dataclass(frozen=True)
class Chessboard(AbstractTarget):
    """A chessboard whose points are its inner corners, row by row.

    The order begins where the square between the first four corners is light, if the colours of the
    board allow it. With this condition most boards have only one possible order.

    Attributes:
        rows, columns: number of inner corners down and across.
        square: side of a square, m.
    """

    rows: int
    columns: int
    square: float

    lengths: ClassVar[tuple[str, ...]] = ("square",)

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(2, rows=self.rows, columns=self.columns)
        require_positive(square=self.square)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The inner corners, row by row, m."""
        return grid_points(self.rows, self.columns, self.square)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """The orders of the corners after rotations that map light squares to light squares."""
        # Rotating by 180 degrees displaces the first square by rows + columns - 4 squares, and
        # rotating a square board by 90 degrees by rows - 2; an odd number changes its colour.
        quarter_rotations = (0, 1, 2, 3) if self.rows % 2 == 0 else (0, 2)
        if (self.rows + self.columns) % 2:
            quarter_rotations = (0,)
        return grid_symmetries(self.rows, self.columns, quarter_rotations)
