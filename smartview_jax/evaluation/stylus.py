"""Simulate the paper's stylus test (Fig. 2): how far a stylus misses the point it should touch.

Errors in pixels can be small for the wrong reason. A stylus that reaches the point where the
calibration locates the target confirms the whole chain.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..calibration import Calibration


def touching(
    tip: Float[np.ndarray, "3"], world_from_tool: SO3, place: Float[np.ndarray, "3"] | None = None
) -> SE3:
    """Return `world_from_tool` at which the tip of a stylus is at a point of the world.

    Args:
        tip: position in the tool's frame, m.
        world_from_tool: `(*touches)` orientations of the tool.
        place: point to touch, m; by default the origin.
    """
    # place = R tip + t, so t = place - R tip.
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
    """Return the position of the tip minus its intended position, in the true world frame, m.

    The calibration gives the pose to command (Eq. 20); the true robot and the true world determine
    where that puts the tip.

    Args:
        calibration: of an eye-in-hand camera, used to command the robot.
        truth: the calibration of the simulation.
        tip: position in the tool's frame, m.
        world_from_tool: `(*touches)` intended poses.
        robot_noise: twists of the commanded poses: `tool_from_base = exp(noise) @ commanded`.
    """
    tool_from_world = world_from_tool.inverse()
    # Eq. 20: the pose to command has the camera at camera_from_tool tool_from_world.
    command = calibration.command_for(calibration.camera_from_tool @ tool_from_world)
    # tool_from_world = tool_from_camera camera_from_world, by the true transforms.
    reached = truth.camera_from_tool.inverse() @ truth.camera_from_world(command)
    if robot_noise is not None:
        reached = SE3.exp(jnp.asarray(robot_noise)) @ reached
    tips = jnp.broadcast_to(jnp.asarray(tip), (*world_from_tool.get_batch_axes(), 3))
    return reached.inverse().apply(tips) - world_from_tool.apply(tips)
