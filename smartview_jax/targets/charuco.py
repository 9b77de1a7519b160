"""Define ChArUco boards: chessboards with markers in their white squares."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from .marker_dictionaries import require_markers
from .target import AbstractTarget, grid_points, require_count, require_flag, require_positive


@dataclasses.dataclass(frozen=True)
class Charuco(AbstractTarget):
    """A ChArUco board whose points are its inner chessboard corners, in OpenCV's order.

    A view may show only some of the corners. The frame is OpenCV's: the origin is the board's outer
    corner, so that the first inner corner is at one square in x and in y.

    Attributes:
        squares_x, squares_y: number of squares across and down.
        square, marker: side of a square and of a marker, m.
        dictionary: name of an OpenCV dictionary, such as `"DICT_4X4_250"`.
        legacy: whether the board has the pattern of OpenCV before 4.6, which differs if
            `squares_y` is even: its first square is white.
    """

    squares_x: int
    squares_y: int
    square: float
    marker: float
    dictionary: str = "DICT_4X4_250"
    legacy: bool = False

    lengths: ClassVar[tuple[str, ...]] = ("square", "marker")

    def __post_init__(self) -> None:
        """Raise a ValueError that names the first attribute that is wrong."""
        require_count(2, squares_x=self.squares_x, squares_y=self.squares_y)
        require_positive(square=self.square, marker=self.marker)
        if self.marker >= self.square:
            raise ValueError(
                f"marker: expected a length below the square's {self.square} m, found {self.marker}"
            )
        require_flag(legacy=self.legacy)
        # Every second square (the white ones) has a marker; the numbers begin at zero.
        require_markers(self.dictionary, self.squares_x * self.squares_y // 2 - 1)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The inner corners, row by row, m."""
        inner = grid_points(self.squares_y - 1, self.squares_x - 1, self.square)
        return inner + np.array([self.square, self.square, 0.0])
