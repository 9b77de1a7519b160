"""Evaluate a robot error field at poses corrected for noise, rather than at reported poses.

A reported pose has an error by the field, which is smooth, and by noise. If the field were
evaluated at reported poses, the estimate of the target's size would be biased: all lengths could
shrink together (target, camera distance, hand-eye transform and, through the field, the motion)
without a change of any pixel, and the noise of the poses would shrink with them, so that a smaller
world would fit better. With the field at poses corrected for noise, the noise stays in the metres
that the robot reports, and shrinking gains nothing.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import host_exponentials, host_matrices, host_transforms
from ..robot_errors import AbstractField, RobotError, nominal_arm
from ..robots import Command, SerialArm
from ..runtime.compilation import compiled
from ..runtime.modules import HostModule
from ..runtime.padding import MIN_PADDED_COUNT, over_padded_views

JOINT_DAMPING = 1e-2
"""Damping of the joint motion that corrects a pose for noise, in m and rad per radian."""


class PreparedPoses(HostModule):
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

    def error(
        self, field: AbstractField, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 4 4"]:
        """Return the error at the tool: a pose without noise times it is the actual pose."""
        return field.prepared_error(self.prepared, coefficients, self.evaluated_from_base)

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
    field, evaluated = error.field, reported
    if corrections is not None:
        arm = nominal_arm(field)
        if arm is not None and reported.joints is not None:
            return over_padded_views(
                lambda padded: _prepare_with_moved_joints(field, arm, *padded),
                (reported, np.asarray(corrections)),
                MIN_PADDED_COUNT,
            )
        # corrected = reported exp(-c), as in the chain.
        pose = host_transforms(
            host_matrices(reported.base_from_tool) @ host_exponentials(-np.asarray(corrections))
        )
        evaluated = Command(pose, reported.joints)
    return over_padded_views(lambda padded: _prepare(field, padded), evaluated)


@compiled
def _prepare(field: AbstractField, evaluated: Command) -> PreparedPoses:
    """Precompute the quantities of a field, compiled."""
    return PreparedPoses.at(field, evaluated)


@compiled
def _prepare_with_moved_joints(
    field: AbstractField,
    arm: SerialArm,
    reported: Command,
    corrections: Float[Array | np.ndarray, "views 6"],
) -> PreparedPoses:
    """Precompute the quantities of a field with the joints moved so that poses have less noise."""
    # The change of the joints that moves the tool by the twist -c, by damped least squares: a
    # redundant arm has several solutions, and a singular pose none.
    # The first coefficients of a field of arm errors are the offsets of its joints.
    by_joints = field.jacobian(reported, jnp.zeros(field.size))[..., : arm.joint_count]
    damping = jnp.broadcast_to(
        JOINT_DAMPING**2 * jnp.eye(arm.joint_count), (len(by_joints),) + 2 * (arm.joint_count,)
    )
    transposed = by_joints.swapaxes(1, 2)
    change = jnp.linalg.solve(
        transposed @ by_joints + damping, -transposed @ corrections[..., None]
    )[..., 0]
    return PreparedPoses.at(field, arm.command(reported.joints + change))
