"""Combine two robot error fields, for data whose likelihood cannot decide between them."""

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command
from .field import AbstractField


class CombinedField(AbstractField):
    """A robot error field that composes the errors of two fields at the tool.

    actual_pose = first.actual_pose(reported) @ reported^-1 @ second.actual_pose(reported)

    Attributes:
        first: a field that depends on poses.
        second: another field, whose groups have other names.
    """

    first: AbstractField
    second: AbstractField

    def __check_init__(self):
        shared_names = {name for name, _ in self.first.groups} & {
            name for name, _ in self.second.groups
        }
        if shared_names:
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
        # The result is inside only where both fields are.
        return jnp.maximum(
            self.first.normalised_distance(reported), self.second.normalised_distance(reported)
        )

    def actual_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        first_coefficients, second_coefficients = jnp.split(coefficients, [self.first.size])
        second_error = reported.base_from_tool.inverse() @ self.second.actual_pose(
            reported, second_coefficients
        )
        return self.first.actual_pose(reported, first_coefficients) @ second_error

    def jacobian(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        first_coefficients, second_coefficients = jnp.split(coefficients, [self.first.size])
        second_error = reported.base_from_tool.inverse() @ self.second.actual_pose(
            reported, second_coefficients
        )
        # With A = second_error = reported^-1 second.actual_pose(reported), a small twist d of
        # F = first.actual_pose(reported) satisfies
        #     F exp(d) A = F A exp(Ad(A^-1) d),
        # so the first field's Jacobian is transformed to the tool by the adjoint of A^-1.
        first_jacobian = second_error.inverse().adjoint() @ self.first.jacobian(
            reported, first_coefficients
        )
        return jnp.concatenate(
            [first_jacobian, self.second.jacobian(reported, second_coefficients)], axis=-1
        )
