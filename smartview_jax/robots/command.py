"""Define what a robot reports or is commanded in a view: its tool pose and its joint readings."""

from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import PoseLike, as_se3

MAX_TOOL_COORDINATE = 10.0
"""Largest plausible coordinate of the tool in the base frame, m.

No arm is that long; a larger number is in another unit, such as millimetres.
"""


class Command(eqx.Module):
    """A tool pose that a robot reports or is commanded, with joint readings where they are known.

    `SerialArm.command` makes one from joint angles.

    Attributes:
        base_from_tool: pose `(*views)` by the controller's own forward kinematics.
        joints: joint readings, rad (m for a prismatic joint); None where they are not known.
    """

    base_from_tool: SE3
    joints: Float[Array, "*views joints"] | None = None


JointsLike: TypeAlias = Float[Array, "*views joints"] | np.ndarray
"""An array of joint readings, rad (m for a prismatic joint)."""

CommandLike: TypeAlias = PoseLike | Command
"""A pose, or a `Command` that holds joint readings too."""


def as_command(command: CommandLike) -> Command:
    """Return a `Command` from a pose or a `Command`."""
    return command if isinstance(command, Command) else Command(as_se3(command))
