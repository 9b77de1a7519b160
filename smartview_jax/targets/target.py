"""What a calibration target is: points in its own frame, and what its pattern cannot tell apart."""

import abc
import dataclasses

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True)
class AbstractTarget(abc.ABC):
    """A target of known geometry; its frame is the world frame of a calibration.

    Points are in metres, x to the right and y down as the pattern is usually drawn, z = 0.
    """

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
        if not 0.0 < value < float("inf"):
            raise ValueError(f"{name}: expected a positive length in metres, found {value}")


def require_count(minimum: int, **counts: int) -> None:
    """Raise a ValueError that names the first count below a minimum."""
    for name, value in counts.items():
        if value != int(value) or value < minimum:
            raise ValueError(
                f"{name}: expected a whole number of at least {minimum}, found {value}"
            )


def grid_points(rows: int, columns: int, spacing: float) -> Float[np.ndarray, "points 3"]:
    """Row by row from the origin: x along the columns, y along the rows."""
    y, x = np.mgrid[0:rows, 0:columns]
    return spacing * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(float)


def grid_rotations(
    rows: int, columns: int, quarter_turns: bool = True
) -> Int[np.ndarray, "symmetries points"]:
    """The rotations that map a grid to itself, as orders of its points; identity first."""
    index = np.arange(rows * columns).reshape(rows, columns)
    turns = range(4) if rows == columns and quarter_turns else (0, 2)
    return np.stack([np.rot90(index, k).ravel() for k in turns])
