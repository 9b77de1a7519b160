"""Simulate the paper's stylus test (Fig. 2): how far a stylus misses the point it should touch.

Errors in pixels can be small although parameters are wrong. A stylus that touches the point where
the calibration locates it confirms the whole chain.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..runtime.array_namespace import as_float_array
from ..runtime.compilation import is_traced

MAX_MISS = 0.1
"""Largest component of a miss, m; a larger one must be in another unit."""


def touching_pose(
    tip: Float[np.ndarray, "3"],
    world_from_tool: SO3,
    point: Float[np.ndarray, "*#touches 3"] | None = None,
) -> SE3:
    """Return `world_from_tool` at which the tip of a stylus is at a point of the world.

    Args:
        tip: position in the tool's frame, m.
        world_from_tool: `(*touches)` orientations of the tool.
        point: point to touch, or one for each orientation, m; by default the origin.
    """
    # NumPy has no program to compile.
    xp = jnp if is_traced(tip, world_from_tool, point) else np
    wxyz = xp.asarray(world_from_tool.wxyz)
    tips, points = (
        xp.broadcast_to(xp.asarray(position), (*wxyz.shape[:-1], 3))
        for position in (tip, np.zeros(3) if point is None else point)
    )
    # point = R tip + t, so t = point - R tip, where for the unit quaternion (w, v)
    #     R tip = tip + 2 (w v x tip + v x (v x tip)).
    across = xp.cross(wxyz[..., 1:], tips)
    turned = tips + 2.0 * (wxyz[..., :1] * across + xp.cross(wxyz[..., 1:], across))
    numbers = xp.concatenate([wxyz, points - turned], axis=-1)
    return SE3(as_float_array(numbers))


def stylus_error(
    calibration: Calibration,
    truth: Calibration,
    tip: Float[np.ndarray, "3"],
    world_from_tool: SE3,
    robot_noise: Float[Array, "*touches 6"] | Float[np.ndarray, "*touches 6"] | None = None,
) -> Float[Array, "*touches 3"]:
    """Return the position of the tip minus its intended position, in the true world frame, m.

    The calibration gives the pose to command (Eq. 20); the true robot and the true world give the
    resulting position of the tip.

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
    tool_from_world_reached = truth.camera_from_tool.inverse() @ truth.camera_from_world(command)
    if robot_noise is not None:
        tool_from_world_reached = SE3.exp(jnp.asarray(robot_noise)) @ tool_from_world_reached
    tips = jnp.broadcast_to(jnp.asarray(tip), (*world_from_tool.get_batch_axes(), 3))
    return tool_from_world_reached.inverse().apply(tips) - world_from_tool.apply(tips)
