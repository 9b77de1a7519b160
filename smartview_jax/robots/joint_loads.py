"""Compute the torques with which gravity loads the joints of an arm."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..runtime.compilation import one_program
from .serial_arm import SerialArm, chain_frames


@one_program
def gravity_loads(
    arm: SerialArm, joints: Float[Array, "*views joints"]
) -> Float[Array, "*views joints"]:
    """Return the torque of gravity about each joint, in parts of the largest that is possible.

    The masses of an arm are rarely known: equal masses are taken at the end of every link, where
    its common normal meets the next joint's axis, and at the tool.
    Stretched out horizontally, the arm loads a joint at its base by about one. The base's z axis
    points up. A prismatic joint has no load.
    """
    tool, frames = chain_frames(arm, joints)
    # A joint turns about z of the frame before its first screw or, in the modified convention, its
    # second.
    screw = 0 if arm.convention == "standard" else 1
    axes = frames.rotation().as_matrix()[..., screw, :, 2]
    origins = frames.translation()
    ends = jnp.concatenate([origins[..., 1:, screw, :], tool.translation()[..., None, :]], axis=-2)
    # With the axis z through the point p, and a mass at c that gravity pulls along -e,
    #     torque = z . ((c - p) x -e) = (z x e) . (c - p).
    # The torques of the masses beyond the joint add up; from joint j on there are n - j masses.
    beyond = jnp.cumsum(ends[..., ::-1, :], axis=-2)[..., ::-1, :]
    count = jnp.arange(arm.joint_count, 0, -1, dtype=float)[:, None]
    lever = beyond - jnp.broadcast_to(count, beyond.shape) * origins[..., screw, :]
    # Since e points along z of the base, z x e = (z_y, -z_x, 0).
    torque = axes[..., 1] * lever[..., 0] - axes[..., 0] * lever[..., 1]
    # Unlike a norm, `hypot` has a derivative at zero, where many tools are.
    tool_at = arm.flange_from_tool.translation()
    tool_length = jnp.hypot(jnp.hypot(tool_at[0], tool_at[1]), tool_at[2])
    reach = jnp.sum(jnp.hypot(arm.a, arm.d)) + tool_length
    largest = 0.5 * arm.joint_count * jnp.where(reach > 0.0, reach, 1.0)
    is_loaded = jnp.broadcast_to(~jnp.array(arm.prismatic), torque.shape)
    return jnp.where(is_loaded, torque / largest, 0.0)
