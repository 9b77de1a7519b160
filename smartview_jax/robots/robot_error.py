"""A fitted error field: where the tool is when the robot says where it is, and the other way."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from .fields import AbstractField

INVERSION_STEPS = 8
"""Of the fixed point behind `reported`; each gains the ratio of error to reach, a hundredth."""


class RobotError(eqx.Module):
    """What a robot's reported poses are wrong by, as a smooth function of them.

    Attributes:
        field: the basis.
        coefficients: of the field, in the order of its `names`.
    """

    field: AbstractField
    coefficients: Float[Array, "coefficients"]

    @classmethod
    def none(cls, field: AbstractField) -> "RobotError":
        """A field that corrects nothing yet."""
        return cls(field, jnp.zeros(field.size))

    def twist(self, reported: SE3) -> Float[Array, "*views 6"]:
        """At the tool: translation (m), then rotation (rad)."""
        return self.field.basis(reported) @ self.coefficients

    def true_pose(self, reported: SE3) -> SE3:
        """`base_from_tool` as it is, from what the robot reports, `(*views)`."""
        return reported @ SE3.exp(-self.twist(reported))

    def reported_pose(self, true: SE3) -> SE3:
        """What the robot reports, and is to be told, to be at a pose; inverts `true_pose`."""

        def closer(reported: SE3, _: None) -> tuple[SE3, None]:
            return true @ SE3.exp(self.twist(reported)), None

        return jax.lax.scan(closer, true, length=INVERSION_STEPS)[0]
