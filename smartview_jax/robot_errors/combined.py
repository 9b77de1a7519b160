"""Combine two robot error fields, for data whose likelihood cannot decide between them."""

from typing import Any

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import adjoint_matrices, inverse_matrices
from ..robots import Command
from .field import AbstractField, AbstractPreparedField


class CombinedField(AbstractPreparedField):
    """A robot error field that composes the errors of two fields at the tool.

    actual_pose = first.actual_pose(reported) @ reported^-1 @ second.actual_pose(reported)

    Attributes:
        first: a field that depends on poses.
        second: another field, whose groups have other names.
    """

    first: AbstractField
    second: AbstractField

    def __check_init__(self) -> None:
        if shared_names := set(self.first.group_names) & set(self.second.group_names):
            raise ValueError(
                "second: expected groups of other names than the first's, found "
                f"{sorted(shared_names)}"
            )

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.first.groups, *self.second.groups)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.first.names, *self.second.names)

    @property
    def reference_length(self) -> float:
        return self.first.reference_length

    def normalised_distance(self, reported: Command) -> Float[Array, "*views"]:
        # A pose is inside the combined field only if it is inside both fields.
        return jnp.maximum(
            self.first.normalised_distance(reported), self.second.normalised_distance(reported)
        )

    def prepare(self, reported: Command) -> tuple[SE3, Any, Any]:
        """Return the reported poses, and what both fields need of them."""
        return (
            reported.base_from_tool,
            self.first.prepare(reported),
            self.second.prepare(reported),
        )

    def prepared_pose(
        self, prepared: tuple[SE3, Any, Any], coefficients: Float[Array, "coefficients"]
    ) -> SE3:
        first_coefficients, second_coefficients = self._split(coefficients)
        pose, first, second = prepared
        return self.first.prepared_pose(first, first_coefficients) @ (
            pose.inverse() @ self.second.prepared_pose(second, second_coefficients)
        )

    def prepared_error(
        self,
        prepared: tuple[SE3, Any, Any],
        coefficients: Float[Array, "coefficients"],
        tool_from_base: SE3,
    ) -> Float[Array, "views 4 4"]:
        first_coefficients, second_coefficients = self._split(coefficients)
        _, first, second = prepared
        return self.first.prepared_error(
            first, first_coefficients, tool_from_base
        ) @ self.second.prepared_error(second, second_coefficients, tool_from_base)

    def _split(
        self, coefficients: Float[Array, "coefficients"]
    ) -> tuple[Float[Array, "first"], Float[Array, "second"]]:
        """Return the coefficients of both fields."""
        return coefficients[: self.first.size], coefficients[self.first.size :]

    def prepared_jacobian(
        self, prepared: tuple[SE3, Any, Any], coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views 6 coefficients"]:
        first_coefficients, second_coefficients = self._split(coefficients)
        pose, first, second = prepared
        # With A = reported^-1 second.actual_pose(reported), a small twist d of
        # F = first.actual_pose(reported) satisfies
        #     F exp(d) A = F A exp(Ad(A^-1) d),
        # so the first field's Jacobian is transformed to the tool by the adjoint of A^-1.
        second_error = self.second.prepared_error(second, second_coefficients, pose.inverse())
        by_first = adjoint_matrices(inverse_matrices(second_error))
        first_jacobian = by_first @ self.first.prepared_jacobian(first, first_coefficients)
        second_jacobian = self.second.prepared_jacobian(second, second_coefficients)
        return jnp.concatenate([first_jacobian, second_jacobian], axis=-1)
