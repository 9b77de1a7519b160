"""Error fields: the part of a robot's error that is a smooth function of where it was sent.

A robot whose joints, links and gears are not quite what its controller believes reports poses that
are wrong by much the same amount wherever it comes back to. A field says, for given coefficients,
where the tool is when the robot says where it is.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import exp_jacobian
from ..robots import Command, JointsLike

INVERSION_STEPS = 8
"""Of the fixed point behind `command`; each gains the ratio of error to reach, a hundredth."""


class AbstractField(eqx.Module):
    """From what a robot reports to where its tool is, and which coefficients share a size.

    A field of your own subclasses this, or `AbstractLinearField`; everything that takes a field
    takes it. Where all coefficients are zero, the tool is where the robot says it is.
    """

    @property
    @abc.abstractmethod
    def groups(self) -> tuple[tuple[str, int], ...]:
        """Name and number of coefficients of each group, in order; a group has one variance."""

    @abc.abstractmethod
    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        """`base_from_tool` as it is, `(*views)`."""

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Twist of `true_pose`, `(views)`, at the tool per unit of each coefficient.

        `true_pose(coefficients + d) = true_pose(coefficients) @ exp(by_coefficients @ d)`.
        """

        def view(one: Command) -> Float[Array, "6 coefficients"]:
            def twist(moved: Float[Array, "coefficients"]) -> Float[Array, "6"]:
                at = self.true_pose(one, jax.lax.stop_gradient(coefficients))
                return (at.inverse() @ self.true_pose(one, moved)).log()

            return jax.jacfwd(twist)(coefficients)

        return jax.vmap(view)(reported)

    def command(
        self,
        true: SE3,
        coefficients: Float[Array, "coefficients"],
        near: JointsLike | None = None,
    ) -> Command:
        """What the robot reports, and is to be told, to be at a pose; inverts `true_pose`.

        Args:
            true: wanted `base_from_tool`, `(*views)`.
            coefficients: of the field.
            near: joint angles in whose neighbourhood to look; for fields of joints alone.
        """
        del near

        def closer(reported: SE3, _: None) -> tuple[SE3, None]:
            arrived = self.true_pose(Command(reported), coefficients)
            return reported @ (arrived.inverse() @ true), None

        return Command(jax.lax.scan(closer, true, length=INVERSION_STEPS)[0])

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        """How far out poses are: 1 at about the edge of those that the field was made for.

        Zero for a field that does not know where it ends.
        """
        return jnp.zeros(reported.base_from_tool.get_batch_axes())

    @property
    def nested(self) -> "tuple[AbstractField, ...]":
        """Simpler fields, each this one with its first groups alone, and this one last."""
        return (self,)

    @property
    def unit_length(self) -> float:
        """Distance, m, per which the coefficients of what grows with the position are."""
        return 1.0

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return sum(count for _, count in self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """One name a coefficient: its group, and its number there."""
        return tuple(f"{group}.{k}" for group, count in self.groups for k in range(count))


class AbstractLinearField(AbstractField):
    """A twist at the tool that is linear in the coefficients.

    tool_from_base = exp(basis(base_from_tool) @ coefficients) @ reported
    """

    @abc.abstractmethod
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 coefficients"]:
        """Twists at the tool, translation (m) first, per unit of each coefficient."""

    def twist(
        self, base_from_tool: SE3, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views 6"]:
        """At the tool: translation (m), then rotation (rad)."""
        return self.basis(base_from_tool) @ coefficients

    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        pose = reported.base_from_tool
        return pose @ SE3.exp(-self.twist(pose, coefficients))

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        basis = self.basis(reported.base_from_tool)
        return -jax.vmap(exp_jacobian)(basis @ coefficients) @ basis
