"""Define the interface of a calibration target: its points and the symmetries of its pattern."""

import abc
import dataclasses
import math
import numbers
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True)
class AbstractTarget(abc.ABC):
    """A target of known geometry, whose frame is the world frame of a calibration.

    Points are in metres, with z = 0 for a flat target. x points to the right of the pattern as it
    is usually printed. y points down and z into the board, as in OpenCV, unless `y_up` is true:
    then y points up and z out of the board, towards the camera.
    """

    y_up: ClassVar[bool] = False
    lengths: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that are lengths on the board; the first one scales it."""

    @property
    @abc.abstractmethod
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The points that a detector finds, in the target's frame, m."""

    @property
    def flat_board(self) -> "AbstractTarget":
        """The target itself; the board, for a board at several heights."""
        return self

    @property
    def height_count(self) -> int:
        """The number of heights at which the target is seen: one, unless it is stacked."""
        return 1

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """The orders of the points that look the same in a picture, the original order first.

        Every row is a permutation. With more than one row, the order in a picture is ambiguous and
        is determined from the robot's motion.
        """
        return np.arange(len(self.points))[None]


def require_positive(**lengths: float) -> None:
    """Raise a ValueError that names the first length that is not positive and finite."""
    for name, value in lengths.items():
        if not (_is_number(value) and 0.0 < value < float("inf")):
            raise ValueError(f"{name}: expected a positive length in metres, found {value!r}")


def require_count(minimum: int, **counts: int) -> None:
    """Raise a ValueError that names the first count below a minimum."""
    for name, value in counts.items():
        if not (isinstance(value, numbers.Integral) and _is_number(value) and value >= minimum):
            raise ValueError(
                f"{name}: expected a whole number of at least {minimum}, found {value!r}"
            )


def require_flag(**flags: bool) -> None:
    """Raise a ValueError that names the first value that is not a `bool`."""
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise ValueError(f"{name}: expected true or false, found {value!r}")


def require_lengths(**lists: Sequence[float]) -> None:
    """Raise a ValueError that names the first list that is empty or not all finite."""
    for name, values in lists.items():
        is_list = isinstance(values, tuple | list) and len(values) > 0
        if not (is_list and all(_is_number(v) and math.isfinite(v) for v in values)):
            raise ValueError(f"{name}: expected a list of lengths in metres, found {values!r}")


def _is_number(value: object) -> bool:
    """Return whether a value is a real number; `True` and `False` are not."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def grid_points(rows: int, columns: int, spacing: float) -> Float[np.ndarray, "points 3"]:
    """Return the points of a flat grid, row by row from the origin.

    Within a row x increases by `spacing`; from row to row y increases by `spacing`.
    """
    y, x = np.mgrid[0:rows, 0:columns]
    return spacing * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(float)


def grid_symmetries(
    rows: int, columns: int, quarter_rotations: tuple[int, ...] = (0, 1, 2, 3)
) -> Int[np.ndarray, "symmetries points"]:
    """Return the orders of a grid's points after rotations that map the grid to itself.

    Args:
        rows, columns: number of points down and across.
        quarter_rotations: rotations to consider, in multiples of 90 degrees. Odd multiples are left
            out unless the grid is square.
    """
    # Rotating the table of indices gives, for each cell, the index of the point that moves to it.
    index = np.arange(rows * columns).reshape(rows, columns)
    return np.stack(
        [np.rot90(index, k).ravel() for k in quarter_rotations if rows == columns or k % 2 == 0]
    )
