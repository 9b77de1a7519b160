"""Provide a fitted robot error field, which maps reported poses to actual poses and back."""

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..array_namespace import to_device
from ..compilation import compiled, compiled_optimised
from ..robots import Command, CommandLike, JointsLike, as_command
from .field import AbstractField


class RobotError(eqx.Module):
    """A robot error field with fitted coefficients.

    Attributes:
        field: the field, which defines the coefficients.
        coefficients: values, in the order of the field's `names`.
    """

    field: AbstractField
    coefficients: Float[Array, "coefficients"]

    @classmethod
    def zero(cls, field: AbstractField) -> "RobotError":
        """Return the error with all coefficients zero, which corrects nothing."""
        return cls(field, to_device(np.zeros(field.size)))

    def converted_to(self, field: AbstractField) -> "RobotError":
        """Return the error with another field, which has some of the same groups of coefficients.

        Coefficients are taken over by name; those that this field does not have are zero. It is the
        same error if those that the other field does not have are zero.
        """
        values = dict(zip(self.field.names, np.asarray(self.coefficients), strict=True))
        return RobotError(field, to_device([float(values.get(name, 0.0)) for name in field.names]))

    def actual_pose(self, reported: CommandLike) -> SE3:
        """Return the actual `base_from_tool` for what the robot reports, `(*views)`."""
        return _actual_pose(self, as_command(reported))

    def jacobian(self, reported: CommandLike) -> Float[Array, "views 6 coefficients"]:
        """Return the twist of the actual pose at the tool per unit of each coefficient.

        The translation (m) comes first.
        """
        return _jacobian(self, as_command(reported))

    def command(self, actual: SE3, near: JointsLike | None = None) -> Command:
        """Return the command that brings the tool to an actual pose; it inverts `actual_pose`.

        Args:
            actual: wanted poses, `(*views)`.
            near: joint readings near which to solve; used by fields of arm errors only.
        """
        return _command(self, actual, near)


# Operation by operation there would be dozens of programs for each number of views.
@compiled
def _actual_pose(error: RobotError, reported: Command) -> SE3:
    """Compute `RobotError.actual_pose` as one program."""
    return error.field.actual_pose(reported, error.coefficients)


@compiled
def _jacobian(error: RobotError, reported: Command) -> Float[Array, "views 6 coefficients"]:
    """Compute `RobotError.jacobian` as one program."""
    return error.field.jacobian(reported, error.coefficients)


@compiled_optimised
def _command(error: RobotError, actual: SE3, near: JointsLike | None) -> Command:
    """Compute `RobotError.command` as one program."""
    return error.field.command(actual, error.coefficients, near)
