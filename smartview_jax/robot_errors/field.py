"""Define robot error fields: the repeatable robot error as a smooth function of the reported pose.

If joints, links and gears of a robot differ from the controller's model, its reported poses are
wrong by nearly the same amount whenever it returns to a pose. For given coefficients, an error
field maps a reported pose to the actual pose of the tool.
"""

import abc
from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import matrix_exponentials, pose_matrices, se3_left_jacobian
from ..robots import Command, JointsLike

INVERSION_STEPS = 8
"""Number of fixed-point steps with which `command` inverts a field.

Each step multiplies the remaining error by the ratio of robot error to reach, about 0.01.
"""


class AbstractField(eqx.Module):
    """A function from a reported robot pose to the actual pose of the tool.

    Its coefficients are in groups; all coefficients of a group have the same variance component.
    With all coefficients zero, the reported pose is the actual one. Subclass this class, or
    `AbstractLinearField`, for a field of your own: every function that takes a field accepts it.
    """

    @property
    @abc.abstractmethod
    def groups(self) -> tuple[tuple[str, int], ...]:
        """The name and size of each group of coefficients, in order; a group has one variance."""

    @property
    def group_names(self) -> tuple[str, ...]:
        """The names of the groups of coefficients, in order."""
        return tuple(name for name, _ in self.groups)

    @abc.abstractmethod
    def actual_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        """Return the actual `base_from_tool`, `(*views)`."""

    def prepare(self, reported: Command) -> Any:
        """Return everything that the field computes from reported poses without its coefficients.

        A fit calls it once, and then `prepared_pose` and `prepared_jacobian` at every step. By
        default it is the report itself. A field that can compute much in advance returns this as
        arrays whose first axis is the views.
        """
        return reported

    def prepared_pose(self, prepared: Any, coefficients: Float[Array, "coefficients"]) -> SE3:
        """Return `actual_pose` from the result of `prepare`."""
        return self.actual_pose(prepared, coefficients)

    def prepared_error(
        self,
        prepared: Any,
        coefficients: Float[Array, "coefficients"],
        tool_from_base: SE3,
    ) -> Float[Array, "views 4 4"]:
        """Return the motion of the tool from reported to actual poses, as matrices.

        Every step of a fit asks for it. A field that can compute it without an `SE3` makes smaller
        programs, which compile in less time.

        Args:
            prepared: result of `prepare` for poses `(views)`.
            coefficients: coefficients of the field.
            tool_from_base: inverse of these poses.
        """
        actual = pose_matrices(self.prepared_pose(prepared, coefficients))
        return pose_matrices(tool_from_base) @ actual

    def prepared_jacobian(
        self, prepared: Any, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Return `jacobian` from the result of `prepare`."""
        return self.jacobian(prepared, coefficients)

    def jacobian(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Return the Jacobian of `actual_pose` with respect to the coefficients.

        For poses `(views)`, it is the twist at the tool per unit of each coefficient d:
        `actual_pose(coefficients + d) = actual_pose(coefficients) @ exp(jacobian @ d)`.
        """

        def view_jacobian(reported_view: Command) -> Float[Array, "6 coefficients"]:
            # Jacobian at c' = c of log(actual_pose(c)^-1 actual_pose(c')), with the first factor
            # constant and c' = `displaced`. Near zero the logarithm is linear, so this is the twist
            # itself.
            def twist(displaced: Float[Array, "coefficients"]) -> Float[Array, "6"]:
                reference_pose = self.actual_pose(
                    reported_view, jax.lax.stop_gradient(coefficients)
                )
                return (reference_pose.inverse() @ self.actual_pose(reported_view, displaced)).log()

            return jax.jacfwd(twist)(coefficients)

        return jax.vmap(view_jacobian)(reported)

    def command(
        self,
        actual: SE3,
        coefficients: Float[Array, "coefficients"],
        near: JointsLike | None = None,
    ) -> Command:
        """Return the command that brings the tool to an actual pose; it inverts `actual_pose`.

        It is the robot's report at this pose.

        Args:
            actual: wanted `base_from_tool`, `(*views)`.
            coefficients: coefficients of the field.
            near: joint readings near which to solve; used by fields of arm errors only.
        """
        del near

        # Fixed point: reported <- reported actual_pose(reported)^-1 actual. It converges because
        # the field changes little over a displacement as small as the error itself; no derivative
        # is needed.
        def fixed_point_step(reported: SE3, _: None) -> tuple[SE3, None]:
            predicted = self.actual_pose(Command(reported), coefficients)
            return reported @ (predicted.inverse() @ actual), None

        return Command(jax.lax.scan(fixed_point_step, actual, length=INVERSION_STEPS)[0])

    def normalised_distance(self, reported: Command) -> Float[Array, "*views"]:
        """Return the distance of poses from the field's centre, in units of the field's extent.

        A value of 1 is about the edge of the poses that the field was made for. The distance is
        zero for a field without a known extent.
        """
        return jnp.zeros(reported.base_from_tool.get_batch_axes())

    @property
    def nested_fields(self) -> "tuple[AbstractField, ...]":
        """The simpler fields that have only the first groups, then this field itself."""
        return (self,)

    @property
    def reference_length(self) -> float:
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

    @property
    def whole(self) -> "AbstractField":
        """The field of the whole errors: this field, unless it has deviations from a type's."""
        return self

    @property
    def is_about_type(self) -> bool:
        """Whether the coefficients are deviations from the errors that a type of robot has."""
        return self.whole is not self

    @property
    def by_coefficients(self) -> Float[np.ndarray, "errors coefficients"]:
        """The derivative of the whole errors by this field's coefficients."""
        return np.eye(self.size)

    @property
    def without_errors(self) -> Float[np.ndarray, "coefficients"]:
        """The coefficients of a robot without any errors, whatever its type has."""
        return np.zeros(self.size)

    def host_whole(
        self, coefficients: Float[np.ndarray, "coefficients"]
    ) -> Float[np.ndarray, "errors"]:
        """Return the coefficients of `whole`, computed with NumPy."""
        return coefficients


class AbstractPreparedField(AbstractField):
    """A robot error field that computes all of its values from what `prepare` returns."""

    @abc.abstractmethod
    def prepare(self, reported: Command) -> Any:
        """Return all that the field needs of reported poses, whatever its coefficients."""

    @abc.abstractmethod
    def prepared_pose(self, prepared: Any, coefficients: Float[Array, "coefficients"]) -> SE3:
        """Return `actual_pose` from what `prepare` returned."""

    @abc.abstractmethod
    def prepared_jacobian(
        self, prepared: Any, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Return `jacobian` from what `prepare` returned."""

    def actual_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        return self.prepared_pose(self.prepare(reported), coefficients)

    def jacobian(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        return self.prepared_jacobian(self.prepare(reported), coefficients)


class AbstractLinearField(AbstractPreparedField):
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

    def prepare(self, reported: Command) -> tuple[SE3, Float[Array, "*views 6 coefficients"]]:
        """Return the reported poses and the basis there."""
        return reported.base_from_tool, self.basis(reported.base_from_tool)

    def prepared_pose(
        self,
        prepared: tuple[SE3, Float[Array, "*views 6 coefficients"]],
        coefficients: Float[Array, "coefficients"],
    ) -> SE3:
        pose, basis = prepared
        return pose @ SE3.exp(-(basis @ coefficients))

    def prepared_error(
        self,
        prepared: tuple[SE3, Float[Array, "*views 6 coefficients"]],
        coefficients: Float[Array, "coefficients"],
        tool_from_base: SE3,
    ) -> Float[Array, "views 4 4"]:
        return matrix_exponentials(-(prepared[1] @ coefficients))

    def prepared_jacobian(
        self,
        prepared: tuple[SE3, Float[Array, "*views 6 coefficients"]],
        coefficients: Float[Array, "coefficients"],
    ) -> Float[Array, "*views 6 coefficients"]:
        # actual_pose = reported exp(-B c), with the basis B; and with the left Jacobian J of exp at
        # B c, to first order in d,
        #     exp(-B (c + d)) = exp(-B c) exp(-J B d).
        _, basis = prepared
        return -se3_left_jacobian(basis @ coefficients) @ basis


FieldChoice: TypeAlias = AbstractField | Literal["auto"] | None
"""A robot error field to fit, None for none, or "auto" to leave the choice to the function."""


def checked_field_choice(field: FieldChoice) -> FieldChoice:
    """Return the choice of a field.

    Raises:
        ValueError: a truth value, or any other text than `"auto"`.
    """
    if isinstance(field, bool) or (isinstance(field, str) and field != "auto"):
        raise ValueError(
            f'field is "auto", None or a field such as robot_errors.JointOffsets(arm); '
            f"found {field!r}"
        )
    return field
