"""The paper's Fig. 2: how far a stylus on the tool misses the place that it is told to touch.

Pixels can be right for the wrong reason; a tool that goes where the calibration says the target is
cannot.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..calibration import Calibration


def touching(
    tip: Float[np.ndarray, "3"], world_from_tool: SO3, place: Float[np.ndarray, "3"] | None = None
) -> SE3:
    """`world_from_tool` with the tip of a stylus at a place of the world.

    Args:
        tip: in the tool's frame, m.
        world_from_tool: `(*touches)` how the tool is turned.
        place: to be touched, m; by default the origin.
    """
    wanted = jnp.zeros(3) if place is None else jnp.asarray(place)
    reach = world_from_tool.apply(jnp.broadcast_to(tip, (*world_from_tool.get_batch_axes(), 3)))
    shift = jnp.broadcast_to(wanted, reach.shape) - reach
    return SE3.from_rotation_and_translation(world_from_tool, shift)


def stylus_miss(
    calibration: Calibration,
    truth: Calibration,
    tip: Float[np.ndarray, "3"],
    world_from_tool: SE3,
    robot_noise: Float[Array, "*touches 6"] | Float[np.ndarray, "*touches 6"] | None = None,
) -> Float[Array, "*touches 3"]:
    """Where the tip is, minus where it should be, in the true world frame, m.

    The calibration says which pose to command (Eq. 20); the true robot and the true world say where
    that puts the tip.

    Args:
        calibration: of a camera on the hand, by which the robot is commanded.
        truth: behind the simulation.
        tip: in the tool's frame, m.
        world_from_tool: `(*touches)` wanted.
        robot_noise: of the commanded poses: `tool_from_base = exp(noise) @ commanded`.
    """
    tool_from_world = world_from_tool.inverse()
    command = calibration.command_for(calibration.camera_from_tool @ tool_from_world)
    reached = truth.camera_from_tool.inverse() @ truth.camera_from_world(command)
    if robot_noise is not None:
        reached = SE3.exp(jnp.asarray(robot_noise)) @ reached
    tips = jnp.broadcast_to(jnp.asarray(tip), (*world_from_tool.get_batch_axes(), 3))
    return reached.inverse().apply(tips) - world_from_tool.apply(tips)
