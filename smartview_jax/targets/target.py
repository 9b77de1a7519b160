"""What a calibration target is: points in its own frame, and what its pattern cannot tell apart."""

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
    """A target of known geometry; its frame is the world frame of a calibration.

    Points are in metres, z = 0 for a flat target. x points to the right as the pattern is usually
    drawn; y points down and z into the board, as OpenCV has it, unless `y_up`: then z points out
    of the board, towards whoever looks at it.
    """

    y_up: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def points(self) -> Float[np.ndarray, "points 3"]:
        """The points that a detector finds, m."""

    @property
    def symmetries(self) -> Int[np.ndarray, "symmetries points"]:
        """Orders of the points that look the same in a picture, the points' own order first.

        Every row is a permutation; more than one row means that robot motion has to decide.
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
    """Raise a ValueError that names the first value that is not a truth value."""
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise ValueError(f"{name}: expected true or false, found {value!r}")


def require_lengths(**lists: Sequence[float]) -> None:
    """Raise a ValueError that names the first list that is not of finite numbers, or is empty."""
    for name, values in lists.items():
        is_list = isinstance(values, tuple | list) and len(values) > 0
        if not (is_list and all(_is_number(v) and math.isfinite(v) for v in values)):
            raise ValueError(f"{name}: expected a list of lengths in metres, found {values!r}")


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def grid_points(rows: int, columns: int, spacing: float) -> Float[np.ndarray, "points 3"]:
    """Row by row from the origin: x along the columns, y along the rows."""
    y, x = np.mgrid[0:rows, 0:columns]
    return spacing * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(float)


def grid_rotations(
    rows: int, columns: int, turns: tuple[int, ...] = (0, 1, 2, 3)
) -> Int[np.ndarray, "symmetries points"]:
    """Orders of a grid's points after these quarter turns, where they map it to itself."""
    index = np.arange(rows * columns).reshape(rows, columns)
    return np.stack([np.rot90(index, k).ravel() for k in turns if rows == columns or k % 2 == 0])
