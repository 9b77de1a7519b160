"""Define robot error fields: the repeatable robot error as a smooth function of the reported pose.

If joints, links and gears of a robot differ from the controller's model, its reported poses are
wrong by nearly the same amount whenever it returns to a pose. For given coefficients, an error
field maps what the robot reports to the true pose of the tool.
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
"""Number of fixed-point steps with which `command` inverts a field.

Each step multiplies the remaining error by the ratio of robot error to reach, about 0.01.
"""


class AbstractField(eqx.Module):
    """A function from what a robot reports to the true pose of its tool, with grouped coefficients.

    All coefficients of a group have the same variance component. Subclass this class, or
    `AbstractLinearField`, for a field of your own: every function that takes a field accepts it.
    With all coefficients zero, the reported pose is the true one.
    """

    @property
    @abc.abstractmethod
    def groups(self) -> tuple[tuple[str, int], ...]:
        """The name and size of each group of coefficients, in order; a group has one variance."""

    @abc.abstractmethod
    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        """Return the true `base_from_tool`, `(*views)`."""

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Return the Jacobian of `true_pose` with respect to the coefficients, for poses `(views)`.

        It is the twist at the tool per unit of each coefficient:
        `true_pose(coefficients + d) = true_pose(coefficients) @ exp(by_coefficients @ d)`.
        """

        def view(one: Command) -> Float[Array, "6 coefficients"]:
            # Jacobian at c' = c of log(true_pose(c)^-1 true_pose(c')), with the first factor
            # constant. Near zero the logarithm is linear, so this is the twist itself.
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
        """Return the command that brings the tool to a true pose; it inverts `true_pose`.

        It is what the robot reports at that pose.

        Args:
            true: wanted `base_from_tool`, `(*views)`.
            coefficients: coefficients of the field.
            near: joint readings near which to solve; used by fields of arm errors only.
        """
        del near

        # Fixed point: reported <- reported true_pose(reported)^-1 true. It converges because the
        # field changes little over the size of the error itself; no derivative is needed.
        def closer(reported: SE3, _: None) -> tuple[SE3, None]:
            arrived = self.true_pose(Command(reported), coefficients)
            return reported @ (arrived.inverse() @ true), None

        return Command(jax.lax.scan(closer, true, length=INVERSION_STEPS)[0])

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        """Return how far poses are from the field's centre, relative to those it was made for.

        A value of 1 is about the edge of those poses.

        It is zero for a field without a known extent.
        """
        return jnp.zeros(reported.base_from_tool.get_batch_axes())

    @property
    def nested(self) -> "tuple[AbstractField, ...]":
        """The simpler fields that consist of the first groups alone, then this field itself."""
        return (self,)

    @property
    def unit_length(self) -> float:
        """The distance, m, to which coefficients of position-dependent groups refer."""
        return 1.0

    @property
    def size(self) -> int:
        """The number of coefficients."""
        return sum(count for _, count in self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each coefficient: its group and its number within the group."""
        return tuple(f"{group}.{k}" for group, count in self.groups for k in range(count))


class AbstractLinearField(AbstractField):
    """A robot error field whose twist at the tool is linear in the coefficients.

    tool_from_base = exp(basis(base_from_tool) @ coefficients) @ reported
    """

    @abc.abstractmethod
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 coefficients"]:
        """Return the twist at the tool, translation (m) first, per unit of each coefficient."""

    def twist(
        self, base_from_tool: SE3, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views 6"]:
        """Return the twist at the tool: translation (m), then rotation (rad)."""
        return self.basis(base_from_tool) @ coefficients

    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        pose = reported.base_from_tool
        return pose @ SE3.exp(-self.twist(pose, coefficients))

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        basis = self.basis(reported.base_from_tool)
        # true_pose = reported exp(-B c), and with the left Jacobian J of exp at B c
        #     exp(-B (c + d)) = exp(-B c) exp(-J B d).
        return -jax.vmap(exp_jacobian)(basis @ coefficients) @ basis
