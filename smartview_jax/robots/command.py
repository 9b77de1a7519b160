"""Define what a robot reports or is commanded in a view: its tool pose and its joint readings."""

from typing import TypeAlias

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import PoseLike, as_se3, host_matrices, host_transforms
from ..runtime.modules import HostModule

MAX_TOOL_COORDINATE = 10.0
"""Largest plausible coordinate of the tool in the base frame, m.

No arm is that long; a larger number is in another unit, such as millimetres.
"""

SAME_POSE_TOLERANCE = 1e-9
"""Largest difference, m or no unit, between the poses that two data sets have for one state."""


class HandPoses(HostModule):
    """The poses of two hands, one with the camera and one with the target, each in its own base.

    Attributes:
        base_from_tool: pose `(*views)` of the hand with the camera, as its arm reported it.
        other_base_from_other_tool: pose `(*views)` of the hand with the target, as the other arm
            reported it.
    """

    base_from_tool: SE3
    other_base_from_other_tool: SE3

    def other_tool_from_tool(self, base_from_other_base: SE3) -> SE3:
        """Return the poses of the camera's hand in the frame of the target's hand."""
        return (base_from_other_base @ self.other_base_from_other_tool).inverse() @ (
            self.base_from_tool
        )

    def host_other_tool_from_tool(self, base_from_other_base: SE3) -> SE3:
        """Return `other_tool_from_tool`, computed with NumPy."""
        base, this_tool, other = map(
            host_matrices,
            (base_from_other_base, self.base_from_tool, self.other_base_from_other_tool),
        )
        return host_transforms(np.linalg.inv(base @ other) @ this_tool)


class Command(HostModule):
    """A tool pose that a robot reports or is commanded, with joint readings where they are known.

    `SerialArm.command` makes one from joint angles.

    Attributes:
        base_from_tool: pose `(*views)` by the controller's own forward kinematics.
        joints: joint readings, rad (m for a prismatic joint); None where they are not known.
        hands: poses of two hands, from which a calibration that knows where both bases are computes
            `base_from_tool`, the pose of one hand in the other; None for one arm.
    """

    base_from_tool: SE3
    joints: Float[Array, "*views joints"] | None = None
    hands: HandPoses | None = None


JointsLike: TypeAlias = Float[Array, "*views joints"] | np.ndarray
"""An array of joint readings, rad (m for a prismatic joint)."""

CommandLike: TypeAlias = PoseLike | Command
"""A pose, or a `Command` that holds joint readings too."""


def as_command(command: CommandLike) -> Command:
    """Return a `Command` from a pose or a `Command`."""
    return command if isinstance(command, Command) else Command(as_se3(command))
