"""Evaluate a robot error field at poses corrected for noise, rather than at reported poses.

A reported pose has an error by the field, which is smooth, and by noise. If the field were
evaluated at reported poses, the estimate of the target's size would be biased: all lengths could
shrink together (target, camera distance, hand-eye transform and, through the field, the motion)
without a change of any pixel, and the noise of the poses would shrink with them, so that a smaller
world would fit better. With the field at poses corrected for noise, the noise stays in the metres
that the robot reports, and shrinking gains nothing.
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
"""Damping of the joint motion that corrects a pose for noise, in m and rad per radian."""


class PreparedPoses(eqx.Module):
    """The precomputed quantities of an error field at the poses where it is evaluated.

    Attributes:
        evaluated_from_base: inverse of the poses where the field is evaluated.
        prepared: result of the field's `prepare` for these poses.
    """

    evaluated_from_base: SE3
    prepared: Any

    @classmethod
    def at(cls, field: AbstractField, evaluated: Command) -> "PreparedPoses":
        """Precompute the quantities of a field at some poses."""
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
    """Precompute the quantities of a field at reported poses, corrected for noise.

    Args:
        error: robot error with the field; None returns None.
        reported: reported poses.
        corrections: twists at the tool that correct reported poses for noise; None if the noise is
            not known.
    """
    if error is None:
        return None
    field = error.field
    evaluated = reported if corrections is None else _less_noise(field, reported, corrections)

    return over_padded_views(lambda padded: _prepare(field, padded), evaluated)


@compiled
def _prepare(field: AbstractField, evaluated: Command) -> PreparedPoses:
    """Precompute the quantities of a field, compiled."""
    return PreparedPoses.at(field, evaluated)


def _less_noise(
    field: AbstractField, reported: Command, corrections: Float[np.ndarray, "views 6"]
) -> Command:
    """Return the reported poses, corrected for noise."""
    # corrected = reported exp(-c), as in the chain.
    pose = host_transforms(
        host_matrices(reported.base_from_tool) @ host_exponentials(-np.asarray(corrections))
    )
    arm = nominal_arm(field)
    if reported.joints is None or arm is None:
        return Command(pose, reported.joints)
    # The change of the joints that moves the tool by the twist -c, by damped least squares: a
    # redundant arm has several solutions, and a singular pose none.
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
