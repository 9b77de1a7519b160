"""Tell which poses are almost the same, up to the symmetry of the object, or in one place."""

import numpy as np
from jaxtyping import Float, Int

from ..modeling import ObjectModel

SAME_POSE_DISTANCE = 0.06
"""Distance of vertices at two poses, RMS over the object's extent, below which they are one."""

SAME_PLACE = 0.5
"""Distance between the middles of two objects, over the smaller extent, that cannot both be there.
"""


def in_one_place(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    other: ObjectModel,
    its_pose: Float[np.ndarray, "4 4"],
) -> bool:
    """Return whether two objects, each at its world_from_object, would be in one place."""
    middles = [
        p[:3, :3] @ m.vertices.mean(axis=0) + p[:3, 3]
        for m, p in ((model, pose), (other, its_pose))
    ]
    smaller = min(one.extent for one in (model, other))
    return bool(np.linalg.norm(middles[0] - middles[1]) < SAME_PLACE * smaller)


def pose_distances(
    model: ObjectModel,
    pose: Float[np.ndarray, "4 4"],
    others: Float[np.ndarray, "poses 4 4"],
) -> Float[np.ndarray, "poses"]:
    """Return the RMS distances of the vertices at a pose from those at others, m.

    Of the poses that the object's symmetry makes equal, the nearest one counts.

    Args:
        model: with its symmetry, where it has one.
        pose: world_from_object.
        others: world_from_object likewise.
    """
    factor = _rms_factor(model)
    equal = _coordinates(pose @ model.object_from_object, factor)
    return np.sqrt(_squared_distances(equal, _coordinates(others, factor)))


def _rms_factor(model: ObjectModel) -> Float[np.ndarray, "4 4"]:
    """Return the matrix C such that vertices at two poses A and B are |(A - B) C| apart, RMS."""
    # The mean over the vertices of |A p - B p|^2 is |(A - B) C|^2 with the mean of p p^T,
    # homogeneous, factored as C C^T: no vertex is needed any more.
    p = np.column_stack([model.vertices, np.ones(len(model.vertices))])
    return np.linalg.qr(p / np.sqrt(len(p)))[1].T


def _coordinates(
    poses: Float[np.ndarray, "poses 4 4"], factor: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "poses 12"]:
    """Return points as far from one another as the vertices at the poses, RMS, m."""
    return (poses @ factor)[:, :3].reshape(-1, 12)


def _squared_distances(
    equal: Float[np.ndarray, "turns 12"], others: Float[np.ndarray, "poses 12"]
) -> Float[np.ndarray, "poses"]:
    """Return the squared distances of points from the nearest of those of equal poses, m^2."""
    # |d - e|^2 = |d|^2 - 2 d . e + |e|^2 with differences from the pose as it is given, the first:
    # one product of matrices, and no digits are lost where the distance is small.
    d, e = others - equal[0], equal - equal[0]
    crossed = (e**2).sum(axis=1) - 2.0 * d @ e.T
    return np.maximum((d**2).sum(axis=1) + crossed.min(axis=1), 0.0)


def distinct_poses(
    model: ObjectModel, poses: Float[np.ndarray, "poses 4 4"], count: int
) -> Int[np.ndarray, "kept"]:
    """Return the first poses that are not almost the same as one before them.

    Args:
        model: with its symmetry, where it has one.
        poses: world_from_object, the best first.
        count: largest number to be returned.

    Returns:
        indices, ascending.
    """
    limit = SAME_POSE_DISTANCE * float(np.linalg.norm(np.ptp(model.vertices, axis=0)))
    # Each kept pose takes its neighbours away, so that few comparisons remain.
    left, kept = np.arange(len(poses)), []
    factor = _rms_factor(model)
    coordinates, turns = _coordinates(poses, factor), model.object_from_object
    while len(left) and len(kept) < count:
        kept.append(int(left[0]))
        equal = _coordinates(poses[left[0]] @ turns, factor)
        far = _squared_distances(equal, coordinates[left]) > limit**2
        left = left[far]
    return np.array(kept, dtype=int)
