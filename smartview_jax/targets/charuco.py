"""ChArUco boards: a chessboard whose white squares carry markers."""

import dataclasses

import numpy as np
from jaxtyping import Float

from .dictionaries import require_markers
from .target import AbstractTarget, grid_points, require_count, require_flag, require_positive


@dataclasses.dataclass(frozen=True)
class Charuco(AbstractTarget):
    """Inner chessboard corners, numbered as OpenCV numbers them; a view may show some of them.

    The frame is OpenCV's: the origin is the board's outer corner, so the first inner corner lies at
    one square in x and in y.

    Attributes:
        squares_x, squares_y: number of squares across and down.
        square, marker: sides, m.
        dictionary: name of an OpenCV dictionary, such as `"DICT_4X4_250"`.
        legacy: the pattern of OpenCV before 4.6, which differs where `squares_y` is even: there
            the first square is white.
    """

    squares_x: int
    squares_y: int
    square: float
    marker: float
    dictionary: str = "DICT_4X4_250"
    legacy: bool = False

    def __post_init__(self):
        require_count(2, squares_x=self.squares_x, squares_y=self.squares_y)
        require_positive(square=self.square, marker=self.marker)
        if self.marker >= self.square:
            raise ValueError(
                f"marker: expected less than the square's {self.square} m, found {self.marker}"
            )
        require_flag(legacy=self.legacy)
        require_markers(self.dictionary, self.squares_x * self.squares_y // 2 - 1)

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        inner = grid_points(self.squares_y - 1, self.squares_x - 1, self.square)
        return inner + np.array([self.square, self.square, 0.0])
