"""Tell which poses are almost the same up to the object's symmetry, and how uncertain they are."""

import numpy as np
from jaxtyping import Float, Int

from ..modeling import ObjectModel

SAME_POSE_DISTANCE = 0.06
"""RMS vertex distance of two poses, over the object's extent, below which they are the same."""


def surface_sigma(model: ObjectModel, covariance: Float[np.ndarray, "6 6"]) -> float:
    """Return the largest standard deviation of a vertex in any direction at a pose, m.

    Args:
        model: of the object.
        covariance: of the pose's tangent at the object, translation first.
    """
    # A tangent (v, w) moves the vertex p by v + w x p.
    turns = np.cross(np.eye(3)[None], model.vertices[:, None])
    moves = np.concatenate([np.tile(np.eye(3), (len(turns), 1, 1)), turns], axis=1)
    spread = moves.swapaxes(1, 2) @ covariance @ moves
    return float(np.sqrt(np.linalg.eigvalsh(spread)[:, -1].max()))


def pose_distances(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    others: Float[np.ndarray, "poses 4 4"],
) -> Float[np.ndarray, "poses"]:
    """Return the RMS distances between the vertices at a pose and at other poses, m.

    Among the poses that are equal by the object's symmetry, the nearest one counts.

    Args:
        model: with its symmetry, if it has one.
        pose: world_from_object.
        others: world_from_object of the other poses.
    """
    factor = _rms_factor(model)
    equal = _coordinates(pose @ model.object_from_object, factor)
    return np.sqrt(_squared_distances(equal, _coordinates(others, factor)))


def _rms_factor(model: ObjectModel) -> Float[np.ndarray, "4 4"]:
    """Return the matrix C for which |(A - B) C| is the RMS vertex distance of two poses A, B."""
    # The mean over the vertices of |A p - B p|^2 is |(A - B) C|^2, where C C^T is the mean of
    # p p^T (homogeneous), so that the vertices themselves are no longer needed.
    p = np.column_stack([model.vertices, np.ones(len(model.vertices))])
    return np.linalg.qr(p / np.sqrt(len(p)))[1].T


def _coordinates(
    poses: Float[np.ndarray, "poses 4 4"], factor: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "poses 12"]:
    """Return points whose distances are the RMS vertex distances of the poses, m."""
    return (poses @ factor)[:, :3].reshape(-1, 12)


def _squared_distances(
    equal: Float[np.ndarray, "turns 12"], others: Float[np.ndarray, "poses 12"]
) -> Float[np.ndarray, "poses"]:
    """Return the squared distances of points from the nearest point of equal poses, m^2."""
    # |d - e|^2 = |d|^2 - 2 d . e + |e|^2 with differences from the first of the equal poses:
    # a single matrix product, and no digits are lost where the distance is small.
    d, e = others - equal[0], equal - equal[0]
    crossed = (e**2).sum(axis=1) - 2.0 * d @ e.T
    return np.maximum((d**2).sum(axis=1) + crossed.min(axis=1), 0.0)


def distinct_poses(
    model: ObjectModel, poses: Float[np.ndarray, "poses 4 4"], count: int
) -> Int[np.ndarray, "kept"]:
    """Return the first poses that are not almost the same as an earlier one.

    Args:
        model: with its symmetry, if it has one.
        poses: world_from_object, the best first.
        count: largest number to be returned.

    Returns:
        indices, ascending.
    """
    limit = SAME_POSE_DISTANCE * float(np.linalg.norm(np.ptp(model.vertices, axis=0)))
    # Each kept pose removes its neighbours, so that few comparisons remain.
    remaining, kept = np.arange(len(poses)), []
    factor = _rms_factor(model)
    coordinates, turns = _coordinates(poses, factor), model.object_from_object
    while len(remaining) and len(kept) < count:
        kept.append(int(remaining[0]))
        equal = _coordinates(poses[remaining[0]] @ turns, factor)
        far = _squared_distances(equal, coordinates[remaining]) > limit**2
        remaining = remaining[far]
    return np.array(kept, dtype=int)
