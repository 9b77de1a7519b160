"""A fitted error field: where the tool is when the robot says where it is, and the other way."""

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command, CommandLike, JointsLike, as_command
from .field import AbstractField


class RobotError(eqx.Module):
    """What a robot's reports are wrong by, as a smooth function of them.

    Attributes:
        field: what the coefficients mean.
        coefficients: of the field, in the order of its `names`.
    """

    field: AbstractField
    coefficients: Float[Array, "coefficients"]

    @classmethod
    def none(cls, field: AbstractField) -> "RobotError":
        """A field that corrects nothing yet."""
        return cls(field, jnp.zeros(field.size))

    def true_pose(self, reported: CommandLike) -> SE3:
        """`base_from_tool` as it is, from what the robot reports, `(*views)`."""
        return self.field.true_pose(as_command(reported), self.coefficients)

    def by_coefficients(self, reported: CommandLike) -> Float[Array, "views 6 coefficients"]:
        """Twist of the true pose at the tool, translation (m) first, per unit of each."""
        return self.field.by_coefficients(as_command(reported), self.coefficients)

    def command(self, true: SE3, near: JointsLike | None = None) -> Command:
        """What the robot reports, and is to be told, to be at a pose; inverts `true_pose`.

        Args:
            true: wanted, `(*views)`.
            near: joint angles in whose neighbourhood to look; for fields of joints alone.
        """
        return self.field.command(true, self.coefficients, near)
