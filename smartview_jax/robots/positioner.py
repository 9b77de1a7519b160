"""Describe a positioner or a linear axis that carries the target by joints of the arm."""

import numpy as np

from ..geometry import PoseLike, as_se3, host_matrices
from .joint_axes import arm_from_axes, axis_frames_at_zero
from .serial_arm import SerialArm


def arm_with_positioner(
    arm: SerialArm, positioner: SerialArm, base_from_positioner: PoseLike
) -> SerialArm:
    """Return the arm as the plate of a positioner sees it, with the positioner's joints as its own.

    The base of this arm is the plate that carries the target. Its joints are the positioner's, the
    last one first, and then the arm's; the readings are as both controllers show them. A data set
    with these readings and poses is one of a camera on the hand of a single arm, so that errors of
    the positioner, and of its place, are fitted as errors of the arm's joints and links.

    Args:
        positioner: the positioner or linear axis; its tool is the plate that carries the target.
        base_from_positioner: pose of the positioner's base in the arm's, as far as it is known.

    For example, a table that turns about the vertical a metre in front of an arm:

        >>> table = sv.robots.arm_from_axes(np.zeros((1, 3)), np.eye(3)[2:], np.eye(4))
        >>> place = np.eye(4)
        >>> place[0, 3] = 1.0
        >>> arm = sv.robots.arm_with_positioner(sv.robots.six_axes(), table, place)
        >>> readings = np.array([[0.5, 0.0, -0.2, 0.7, 0.0, 1.0, 0.0]])  # of the table, of the arm
        >>> plate_from_tool = arm.base_from_tool(readings)
        >>> print(plate_from_tool.get_batch_axes(), arm.joint_count)
        (1,) 7
    """
    plate = host_matrices(positioner.flange_from_tool)
    frames, end = axis_frames_at_zero(positioner)
    # The positioner moves its plate; seen from the plate, its base is moved the other way.
    plate_from_positioner = np.linalg.inv(end @ plate)
    plate_from_base = plate_from_positioner @ np.linalg.inv(
        host_matrices(as_se3(base_from_positioner))
    )
    own_frames, flange = axis_frames_at_zero(arm)
    tool = flange @ host_matrices(arm.flange_from_tool)
    # Seen from the plate, the positioner's axes turn the other way, and the last one comes first.
    frames = plate_from_positioner @ frames[::-1] @ np.diag([-1.0, 1.0, -1.0, 1.0])
    axes = np.concatenate([frames, plate_from_base @ own_frames])
    return arm_from_axes(
        axes[:, :3, 3],
        axes[:, :3, 2],
        plate_from_base @ tool,
        prismatic=(*positioner.prismatic[::-1], *arm.prismatic),
        limits=np.vstack([np.asarray(positioner.limits)[::-1], np.asarray(arm.limits)]),
    )
