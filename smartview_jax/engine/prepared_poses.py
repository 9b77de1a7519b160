"""Evaluate a robot error field where the robot was, rather than where it said it was.

A reported pose is wrong by the field, which is smooth, and by noise. If the field were evaluated at
reported poses while the target's size multiplies the poses that the pictures show, noise would
enter the equations on one side only. All lengths could then shrink together (target, camera
distance, hand-eye transform, and through the field the motion) without a change in any pixel, and
the noise would shrink with them: each view would pay the estimate to make the world smaller.
Evaluated at reported poses less their noise, the field is a function of the same poses as the size.
The noise stays in the metres that the robot reports, and shrinking gains nothing.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import host_exponentials, host_matrices, host_transforms
from ..robot_errors import AbstractField, RobotError, nominal_arm
from ..robots import Command
from ..runtime.compilation import compiled
from ..runtime.padding import over_padded_views

JOINT_DAMPING = 1e-2
"""Damping of the joints' motion that undoes the noise of a pose, in m and rad per radian."""


class PreparedPoses(eqx.Module):
    """All that an error field needs of the poses where it is evaluated.

    Attributes:
        evaluated_from_base: inverse of the poses where the field is evaluated.
        prepared: result of the field's `prepare` for these poses.
    """

    evaluated_from_base: SE3
    prepared: Any

    @classmethod
    def at(cls, field: AbstractField, evaluated: Command) -> "PreparedPoses":
        """Return what a field needs of the poses where it is evaluated."""
        return cls(evaluated.base_from_tool.inverse(), field.prepare(evaluated))

    def error(self, field: AbstractField, coefficients: Float[Array, "coefficients"]) -> SE3:
        """Return the error at the tool: a pose without noise times it is the actual pose."""
        return self.evaluated_from_base @ field.prepared_pose(self.prepared, coefficients)

    def jacobian(
        self, field: AbstractField, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Return the Jacobian of the actual poses, a twist at the tool."""
        # A constant factor on the left does not change a twist at the tool.
        return field.prepared_jacobian(self.prepared, coefficients)


def prepare_poses(
    error: RobotError | None,
    reported: Command,
    corrections: Float[np.ndarray, "views 6"] | None = None,
) -> PreparedPoses | None:
    """Return what a field needs of reported poses, evaluated at these poses less their noise.

    Args:
        error: robot error with the field; None returns None.
        reported: what the robot reported.
        corrections: twists at the tool by which reported poses are corrected for noise; None where
            the noise is not known.
    """
    if error is None:
        return None
    field = error.field
    evaluated = reported if corrections is None else _less_noise(field, reported, corrections)

    return over_padded_views(lambda padded: _prepare(field, padded), evaluated)


@compiled
def _prepare(field: AbstractField, evaluated: Command) -> PreparedPoses:
    """Return what a field needs of the poses where it is evaluated, compiled."""
    return PreparedPoses.at(field, evaluated)


def _less_noise(
    field: AbstractField, reported: Command, corrections: Float[np.ndarray, "views 6"]
) -> Command:
    """Return the poses that a robot without noise would have reported."""
    # corrected = reported exp(-c), as in the chain.
    pose = host_transforms(
        host_matrices(reported.base_from_tool) @ host_exponentials(-np.asarray(corrections))
    )
    arm = nominal_arm(field)
    if reported.joints is None or arm is None:
        return Command(pose, reported.joints)
    # The joints that move the tool by the twist -c, by least squares: a redundant arm has several
    # such motions, and in a singular pose there is none.
    by_coefficients = over_padded_views(lambda padded: _jacobian_at_zero(field, padded), reported)
    # The first coefficients of a field of arm errors are the offsets of its joints.
    by_joints = np.asarray(by_coefficients)[..., : arm.joint_count]
    damping = JOINT_DAMPING**2 * np.eye(arm.joint_count)
    transposed = by_joints.swapaxes(1, 2)
    change = np.linalg.solve(
        transposed @ by_joints + damping, -transposed @ np.asarray(corrections)[..., None]
    )[..., 0]
    return over_padded_views(
        lambda padded: arm.command(padded), np.asarray(reported.joints) + change
    )


@compiled
def _jacobian_at_zero(
    field: AbstractField, reported: Command
) -> Float[Array, "views 6 coefficients"]:
    """Return the Jacobian of a field without any error."""
    return field.jacobian(reported, jnp.zeros(field.size))
