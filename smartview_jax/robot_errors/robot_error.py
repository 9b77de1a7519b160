"""Provide a fitted robot error field, which maps reported poses to true poses and back."""

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

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
    def none(cls, field: AbstractField) -> "RobotError":
        """Return the error with all coefficients zero, which corrects nothing."""
        return cls(field, jnp.zeros(field.size))

    def true_pose(self, reported: CommandLike) -> SE3:
        """Return the true `base_from_tool` for what the robot reports, `(*views)`."""
        return self.field.true_pose(as_command(reported), self.coefficients)

    def by_coefficients(self, reported: CommandLike) -> Float[Array, "views 6 coefficients"]:
        """Return the twist of the true pose at the tool per unit of each coefficient.

        The translation (m) comes first.
        """
        return self.field.by_coefficients(as_command(reported), self.coefficients)

    def command(self, true: SE3, near: JointsLike | None = None) -> Command:
        """Return the command that brings the tool to a true pose; it inverts `true_pose`.

        Args:
            true: wanted poses, `(*views)`.
            near: joint readings near which to solve; used by fields of arm errors only.
        """
        return self.field.command(true, self.coefficients, near)
