"""Describe the fixed parts of a cell: the table, with or without a board, and a bin on it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...geometry import host_poses
from ...robots import BOX_CORNERS, BOX_TRIANGLES
from ...targets import AbstractTarget
from ..patterns import printed_pattern
from ..solid_scenes import Surface
from ..textures import Texture, labelled, speckled

BOARD_MARGIN = 0.022
"""Width of the white border about the points of the board, m."""

INK, PAPER = 0.12, 0.9
"""Albedo of the board's print and of its paper."""


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
        return host_poses(np.eye(3), self.centre)

    @property
    def surface(self) -> Surface:
        """The visible surface of the box."""
        vertices = self.centre + BOX_CORNERS * self.size
        return Surface(vertices, BOX_TRIANGLES, speckled(0.3, 0.03, 0.004, seed=8))


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


def table_texture(seed: int, clutter: bool) -> Texture:
    """Return the texture of a table, with labels and scraps of paper if there is clutter."""
    wood = speckled(0.45, 0.03, 0.006, seed=seed + 3)
    return labelled(wood, 24, 0.06, 0.35, seed=seed + 4) if clutter else wood


def board_on_table(board: AbstractTarget, table: Texture) -> Texture:
    """Return the texture of a table with a board on it, printed on paper without thickness."""
    if not board.y_up:
        raise ValueError("the board of a cell has z upwards: give it as a StackedTarget")
    # Only the flat board is printed.
    flat = board.flat_board
    is_dark: Callable = printed_pattern(flat)
    # The y axis of a stack points up, but down on most boards.
    sign = 1.0 if flat.y_up else -1.0
    lower = board.points.min(axis=0)[:2] - BOARD_MARGIN
    upper = board.points.max(axis=0)[:2] + BOARD_MARGIN

    def texture(points: np.ndarray) -> np.ndarray:
        albedo = table(points)
        inside = ((points[:, :2] > lower) & (points[:, :2] < upper)).all(axis=1)
        x, y = points[inside, 0], sign * points[inside, 1]
        albedo[inside] = np.where(is_dark(x, y), INK, PAPER)
        return albedo

    return texture
