"""Find initial joint axes of an arm in the frame of a camera that observes its motion."""

import numpy as np
from jaxtyping import Float

from ..geometry import (
    host_exponentials,
    host_matrices,
    host_nearest_rotation,
    host_poses,
    host_rotation_vectors,
)
from ..robots import SerialArm, axis_frames_at_zero
from .product_of_exponentials import AXIS_TWISTS, ProductOfExponentials

MAX_REST_MOTION = 2e-3
"""The largest change of a reading between two views of a joint at rest, rad or m."""

MIN_JOINT_MOTION, MAX_JOINT_MOTION = 0.05, 2.5
"""The smallest (rad or m) and largest (rad) joint motion from which an axis is found.

The upper limit stays below pi: a rotation by more than pi has the opposite axis.
"""

MAX_VIEWS = 300
"""The largest number of views whose pairs are all examined."""


def axes_from_motions(
    joints: Float[np.ndarray, "views joints"],
    poses: Float[np.ndarray, "views 4 4"],
    prismatic: tuple[bool, ...],
) -> ProductOfExponentials:
    """Find the joint axes in order, each from views between which no later joint moves.

    Between two such views, once the motion of the earlier joints is removed, the target moves about
    (or along) that axis alone.

    Raises:
        ValueError: no pair of views determines a joint's axis; the message names the joint.
    """
    subsample = np.unique(np.linspace(0, len(joints) - 1, MAX_VIEWS).astype(int))
    remaining, frames_found = poses, []
    for k, is_prismatic in enumerate(prismatic):
        frame = _joint_axis_frame(
            joints[subsample, k], joints[subsample, k + 1 :], remaining[subsample], is_prismatic
        )
        if frame is None:
            raise ValueError(
                f"no two views determine the axis of joint {1 + k}: it has to move by at least "
                f"{MIN_JOINT_MOTION} rad or m while the joints after it rest; or give start=, the "
                "nominal arm"
            )
        frames_found.append(frame)
        # Remove this joint's motion: remaining <- F_k exp(-q_k z) F_k^-1 remaining. What remains is
        # the motion of the later joints and the constant pose `home`.
        motion = host_exponentials(-joints[:, k, None] * AXIS_TWISTS[int(is_prismatic)])
        remaining = frame @ motion @ np.linalg.inv(frame) @ remaining
    # With all joints removed every view gives an estimate of `home`; one is enough to start.
    home = remaining[len(remaining) // 2]
    return ProductOfExponentials(np.stack(frames_found), np.ones(len(prismatic)), home)


def axes_from_arm(
    start: SerialArm,
    joints: Float[np.ndarray, "views joints"],
    poses: Float[np.ndarray, "views 4 4"],
) -> ProductOfExponentials:
    """Return a known arm's axes, its base and the target positioned to match measured poses.

    The model is `P = X B Y` for every view, with P the measured pose, B the arm's forward
    kinematics, X the pose of its base and Y the pose of the target on its flange. The rotation part
    is linear in the rotation matrices of X and of inverse Y; given these, the translation part is
    linear in their translations.
    """
    B, P = host_matrices(start.base_from_tool(joints)), poses
    # Rotation part, stacked by rows: R_P R_Y^-1 - R_X R_B = 0. With vec by rows and the Kronecker
    # product x, vec(R_P M) = (R_P x I) vec(M) and vec(M R_B) = (I x R_B^T) vec(M). The solution is
    # the right singular vector of the smallest singular value, up to a factor; both halves are then
    # projected onto rotations.
    identity = np.eye(3)
    rows = [
        np.hstack([np.kron(p, identity), -np.kron(identity, b.T)])
        for p, b in zip(P[:, :3, :3], B[:, :3, :3], strict=True)
    ]
    rotations = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(2, 3, 3)
    rotations = rotations * np.sign(np.linalg.det(rotations[0]))
    inverse_rotation_y, rotation_x = (host_nearest_rotation(m) for m in rotations)
    # Translation part: t_P - R_X t_B = R_X R_B t_Y + t_X.
    A = np.concatenate([np.hstack([rotation_x @ b[:3, :3], identity]) for b in B])
    differences = P[:, :3, 3] - B[:, :3, 3] @ rotation_x.T
    translations = np.linalg.lstsq(A, differences.ravel(), rcond=None)[0]
    camera_from_base = host_poses(rotation_x, translations[3:])
    tool_from_target = host_poses(inverse_rotation_y.T, translations[:3])
    base_from_tool = host_matrices(start.base_from_tool(np.zeros(start.joint_count)))
    axes, _ = axis_frames_at_zero(start)
    home = camera_from_base @ base_from_tool @ tool_from_target
    return ProductOfExponentials(camera_from_base @ axes, np.ones(start.joint_count), home)


def _joint_axis_frame(
    readings: Float[np.ndarray, "views"],
    later_readings: Float[np.ndarray, "views others"],
    remaining: Float[np.ndarray, "views 4 4"],
    is_prismatic: bool,
) -> Float[np.ndarray, "4 4"] | None:
    """Return a frame on the axis that the rigid motions between pairs of views share, or None.

    The result is None if no pair of views has a large enough motion of this joint while all later
    joints are at rest.
    """
    i, j = np.triu_indices(len(readings), 1)
    displacement = readings[j] - readings[i]
    others_at_rest = (np.abs(later_readings[j] - later_readings[i]) < MAX_REST_MOTION).all(axis=1)
    selected = (
        others_at_rest
        & (np.abs(displacement) > MIN_JOINT_MOTION)
        & (is_prismatic | (np.abs(displacement) < MAX_JOINT_MOTION))
    )
    if not selected.any():
        return None
    # M_ij = T_j T_i^-1 = F exp((q_j - q_i) z) F^-1: a rotation about, or a translation along, the
    # axis.
    motion = remaining[j[selected]] @ np.linalg.inv(remaining[i[selected]])
    rotation = motion[:, :3, :3]
    if is_prismatic:
        # The position of a prismatic joint's axis has no effect on the motion; any point will do.
        axis = np.mean(motion[:, :3, 3] / displacement[selected, None], axis=0)
        point = remaining[0, :3, 3]
    else:
        # Rotation vectors are summed with the sign of the joint's motion, so that long rotations
        # weigh most.
        rotation_vectors = host_rotation_vectors(rotation)
        axis = np.sum(rotation_vectors * np.sign(displacement[selected])[:, None], axis=0)
        # A rotation M = (R, t) leaves the points p of its axis fixed: t = (I - R) p. The extra row
        # a . p = 0 selects the point nearest the origin.
        A = np.concatenate([*(np.eye(3) - rotation), axis[None] / np.linalg.norm(axis)])
        point = np.linalg.lstsq(A, np.append(motion[:, :3, 3].ravel(), 0.0), rcond=None)[0]
    # Any x axis perpendicular to z will do; the coordinate axis least parallel to z gives one.
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return host_poses(np.stack([x, np.cross(z, x), z], axis=1), point)
