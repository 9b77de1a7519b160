"""Write the positions of the chain as linear equations, once the rotations are known.

With the hand-eye rotation R, the positions of `camera = X robot W` are

    c = x + R R_robot w + s R t_robot

linear in the positions x and w of both transforms and in the ratio s of the camera's unit of length
to the robot's. What else may have moved the target away by a little is one more column for each of
its numbers.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .closure import Poses
from .misfit_evidence import evidence
from .transform_fit import Matrix

Columns = Float[np.ndarray, "views 3 numbers"]
"""Derivatives of the target's position in each view, in the camera's axes."""


class PositionFit(NamedTuple):
    """Least squares of positions.

    Attributes:
        numbers: one for each column.
        errors: what is left over in each view, in the camera's axes, m.
    """

    numbers: Float[np.ndarray, "numbers"]
    errors: Float[np.ndarray, "views 3"]

    @property
    def mean_error(self) -> float:
        """Mean length of the errors, m."""
        return float(np.linalg.norm(self.errors, axis=1).mean())


def transform_columns(robot: Poses, camera_from_mount: Matrix) -> Columns:
    """Return the six columns of both transforms' positions.

    Args:
        robot: `mount_from_holder` of the views.
        camera_from_mount: the hand-eye transform, whose rotation is used.
    """
    eye = np.broadcast_to(np.eye(3), (len(robot), 3, 3))
    return np.concatenate([eye, camera_from_mount[:3, :3] @ robot[:, :3, :3]], axis=2)


def robot_column(robot: Poses, camera_from_mount: Matrix) -> Columns:
    """Return the column of the robot's own positions, whose number is the ratio of the lengths."""
    return (robot[:, :3, 3] @ camera_from_mount[:3, :3].T)[..., None]


def fit_positions(columns: Columns, positions: Float[np.ndarray, "views 3"]) -> PositionFit:
    """Return the numbers that explain positions best; the smallest ones where several do."""
    matrix = columns.reshape(-1, columns.shape[2])
    sizes = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    numbers = np.linalg.lstsq(matrix / sizes, positions.ravel(), rcond=1e-9)[0] / sizes
    return PositionFit(numbers, positions - columns @ numbers)


def evidence_of_positions(given: PositionFit, explained: PositionFit, parameters: int) -> float:
    """Return twice the logarithm of the odds of an explanation, by Schwarz's criterion.

    Args:
        given: without the explanation.
        explained: with it.
        parameters: how many numbers it has more.
    """
    before, after = (fit.errors[:, None] for fit in (given, explained))
    return evidence(before, after, parameters)
