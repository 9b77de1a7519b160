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
    smaller = min(float(np.ptp(one.vertices, axis=0).max()) for one in (model, other))
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
    turns = np.eye(4)[None] if model.symmetry is None else model.symmetry.object_from_object
    # Mean over the vertices of |A p - B p|^2 = |(A - B) C|^2 with the mean of p p^T, homogeneous,
    # factored as C C^T: no vertex is needed any more.
    p = np.column_stack([model.vertices, np.ones(len(model.vertices))])
    factor = np.linalg.qr(p / np.sqrt(len(p)))[1].T
    equal = (pose @ turns @ factor)[None]
    gaps = ((others @ factor)[:, None] - equal)[..., :3, :]
    return np.sqrt((gaps**2).sum(axis=(-1, -2)).min(axis=1))


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
    while len(left) and len(kept) < count:
        kept.append(int(left[0]))
        left = left[pose_distances(model, poses[left[0]], poses[left]) > limit]
    return np.array(kept, dtype=int)
