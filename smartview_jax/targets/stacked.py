"""The paper's target: one board, placed at several known heights under the same viewpoint."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from .target import AbstractTarget


@dataclasses.dataclass(frozen=True)
class StackedTarget(AbstractTarget):
    """A board at several heights z; all heights of one viewpoint belong to that viewpoint.

    One picture is taken at each height, with the robot standing still. Together the points are not
    coplanar, which is what Step 1's linear start asks for.

    Attributes:
        board: the flat target.
        heights: z of the board in the world frame at each placing, m.
    """

    board: AbstractTarget
    heights: tuple[float, ...]

    def __post_init__(self):
        if not self.heights or len(set(self.heights)) != len(self.heights):
            raise ValueError(f"heights: expected different numbers, found {self.heights}")

    @property
    def points(self) -> Float[np.ndarray, "points 3"]:
        flat = self.board.points
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
