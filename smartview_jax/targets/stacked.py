"""Define the paper's target: one board at several known heights under the same viewpoint."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from .target import AbstractTarget, require_lengths


@dataclasses.dataclass(frozen=True)
class StackedTarget(AbstractTarget):
    """A flat board that is used at several heights z, as one target that is not flat.

    One picture is taken at each height while the robot does not move, and the points of all heights
    form one view. Together they are not coplanar, as the linear start of Step 1 requires.

    A greater height is nearer to the camera, so z points out of the board here. Boards whose own
    frame has y down are rotated to y up (180 degrees about x); otherwise z would be mirrored.

    Attributes:
        board: the flat target.
        heights: z of the board in the world frame in each picture, m.
    """

    board: AbstractTarget
    heights: tuple[float, ...]

    y_up: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Raise a ValueError if the board is itself stacked or the heights are not distinct."""
        if isinstance(self.board, StackedTarget):
            raise ValueError("board: expected a flat target, found a target with heights")
        require_lengths(heights=self.heights)
        object.__setattr__(self, "heights", tuple(float(z) for z in self.heights))
        if len(set(self.heights)) != len(self.heights):
            raise ValueError(f"heights: expected different numbers, found {self.heights}")

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The points of the board at the first height, then at the second, and so on, m."""
        # Rotating by 180 degrees about x changes the sign of y; z of a flat board stays zero.
        flat = self.board.points * np.array([1.0, 1.0 if self.board.y_up else -1.0, 1.0])
        return np.concatenate([flat + np.array([0.0, 0.0, z]) for z in self.heights])

    @property
    def flat_board(self) -> AbstractTarget:
        """The board."""
        return self.board

    @property
    def height_count(self) -> int:
        """The number of heights."""
        return len(self.heights)

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """The orders of the board that look the same, applied at all heights alike."""
        # Point p of the board has the index p + k count at height k.
        count = len(self.board.points)
        return np.stack(
            [
                np.concatenate([order + k * count for k in range(len(self.heights))])
                for order in self.board.symmetries
            ]
        )
