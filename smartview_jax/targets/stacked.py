"""The paper's target: one board, placed at several known heights under the same viewpoint."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from .target import AbstractTarget, require_lengths


@dataclasses.dataclass(frozen=True)
class StackedTarget(AbstractTarget):
    """A board at several heights z; all heights of one viewpoint belong to that viewpoint.

    One picture is taken at each height, with the robot standing still. Together the points are not
    coplanar, which is what Step 1's linear start asks for.

    A greater height is nearer to the camera, so z points out of the board here: boards whose own
    frame has y down are turned to y up (half a turn about x), or z would be mirrored.

    Attributes:
        board: the flat target.
        heights: z of the board in the world frame at each placing, m.
    """

    board: AbstractTarget
    heights: tuple[float, ...]

    y_up: ClassVar[bool] = True

    def __post_init__(self):
        if isinstance(self.board, StackedTarget):
            raise ValueError("board: expected a flat target, found one that has heights itself")
        require_lengths(heights=self.heights)
        object.__setattr__(self, "heights", tuple(float(z) for z in self.heights))
        if len(set(self.heights)) != len(self.heights):
            raise ValueError(f"heights: expected different numbers, found {self.heights}")

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        flat = self.board.points * np.array([1.0, 1.0 if self.board.y_up else -1.0, 1.0])
        return np.concatenate([flat + np.array([0.0, 0.0, z]) for z in self.heights])

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        count = len(self.board.points)
        return np.stack(
            [
                np.concatenate([order + k * count for k in range(len(self.heights))])
                for order in self.board.symmetries
            ]
        )
