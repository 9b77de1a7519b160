"""What a robot says of a view: where its tool is, and its joints' angles where they are known."""

from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import PoseLike, as_se3

FARTHEST = 10.0
"""Of a tool's coordinate in the base's frame, m: no arm is longer; what is, is in another unit."""


class Command(eqx.Module):
    """A pose as reported or commanded; `SerialArm.command` makes one from joint angles.

    Attributes:
        base_from_tool: `(*views)`, as the robot's controller has it.
        joints: readings, rad (m for a prismatic joint); None where they are not known.
    """

    base_from_tool: SE3
    joints: Float[Array, "*views joints"] | None = None


JointsLike: TypeAlias = Float[Array, "*views joints"] | np.ndarray
"""Readings of joints, rad (m for a prismatic joint)."""

CommandLike: TypeAlias = PoseLike | Command
"""A pose, or a `Command` that knows the joints too."""


def as_command(command: CommandLike) -> Command:
    """A `Command` from either form."""
    return command if isinstance(command, Command) else Command(as_se3(command))
