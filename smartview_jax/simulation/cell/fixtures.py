"""Describe the fixed parts of a cell: the table, and a bin on it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...robots import BOX_CORNERS, BOX_TRIANGLES
from ..solid_scenes import Surface
from ..textures import Texture, speckled


class FixedBox(NamedTuple):
    """A box that does not move, along the axes of the world.

    Attributes:
        name: for messages.
        centre: m.
        size: along x, y and z, m.
    """

    name: str
    centre: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]

    @property
    def world_from_box(self) -> Float[np.ndarray, "4 4"]:
        """The pose of the box's own frame, whose origin is its middle."""
        pose = np.eye(4)
        pose[:3, 3] = self.centre
        return pose

    def surface(self, texture: Texture | None = None) -> Surface:
        """Return the visible surface of the box."""
        vertices = self.centre + BOX_CORNERS * self.size
        return Surface(vertices, BOX_TRIANGLES, texture or speckled(0.3, 0.03, 0.004, seed=8))


class Bin(NamedTuple):
    """An open bin on the table, its walls along x and y.

    Attributes:
        centre: x and y of its middle, m.
        size: inner width along x, inner depth along y, and height of the walls, m.
        wall: thickness of the walls, m.
    """

    centre: tuple[float, float]
    size: tuple[float, float, float] = (0.24, 0.18, 0.05)
    wall: float = 0.004

    @property
    def boxes(self) -> tuple[FixedBox, ...]:
        """The four walls; the table is the floor."""
        width, depth, height = self.size
        x, y = self.centre
        # Boxes are given by their middle: half the height above the table.
        z, t = 0.5 * height, self.wall
        # The walls along x are longer, so that the corners are closed.
        across, along = np.array([t, depth, height]), np.array([width + 2.0 * t, t, height])
        return (
            FixedBox("bin wall -x", np.array([x - 0.5 * (width + t), y, z]), across),
            FixedBox("bin wall +x", np.array([x + 0.5 * (width + t), y, z]), across),
            FixedBox("bin wall -y", np.array([x, y - 0.5 * (depth + t), z]), along),
            FixedBox("bin wall +y", np.array([x, y + 0.5 * (depth + t), z]), along),
        )

    @property
    def rim(self) -> float:
        """The height of the walls' upper edge, m."""
        return self.size[2]
