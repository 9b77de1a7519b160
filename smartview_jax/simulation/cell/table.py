"""Draw the table of a cell, with or without the board that calibrates it."""

from collections.abc import Callable

import numpy as np

from ...targets import AbstractTarget, StackedTarget
from ..patterns import printed_pattern
from ..textures import Texture, labelled, speckled

BOARD_MARGIN = 0.022
"""Width of the white border about the points of the board, m."""

INK, PAPER = 0.12, 0.9
"""Albedo of the board's print and of its paper."""


def table_texture(seed: int, clutter: bool) -> Texture:
    """Return the texture of a table, with labels and scraps of paper if there is clutter."""
    wood = speckled(0.45, 0.03, 0.006, seed=seed + 3)
    return labelled(wood, 24, 0.06, 0.35, seed=seed + 4) if clutter else wood


def board_on_table(board: AbstractTarget, table: Texture) -> Texture:
    """Return the texture of a table with a board on it, printed on paper without thickness.

    Raises:
        ValueError: the board's z points into the table, or its pattern is unknown.
    """
    if not board.y_up:
        raise ValueError("the board of a cell has z upwards: give it as a StackedTarget")
    # Only the flat board is printed.
    flat = board.board if isinstance(board, StackedTarget) else board
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
