"""Combine two robot error fields, for data whose likelihood cannot decide between them."""

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command
from .field import AbstractField


class CombinedField(AbstractField):
    """A robot error field that composes the errors of two fields at the tool.

    base_from_tool = first.true_pose(reported) @ reported^-1 @ second.true_pose(reported)

    Attributes:
        first: a field that depends on poses.
        second: another field, whose groups have other names.
    """

    first: AbstractField
    second: AbstractField

    def __check_init__(self):
        both = {name for name, _ in self.first.groups} & {name for name, _ in self.second.groups}
        if both:
            raise ValueError(
                f"second: expected groups of other names than the first's, found {sorted(both)}"
            )

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.first.groups, *self.second.groups)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.first.names, *self.second.names)

    @property
    def unit_length(self) -> float:
        return self.first.unit_length

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return jnp.maximum(self.first.extent(reported), self.second.extent(reported))

    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        first, second = jnp.split(coefficients, [self.first.size])
        after = reported.base_from_tool.inverse() @ self.second.true_pose(reported, second)
        return self.first.true_pose(reported, first) @ after

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        first, second = jnp.split(coefficients, [self.first.size])
        after = reported.base_from_tool.inverse() @ self.second.true_pose(reported, second)
        # With A = reported^-1 second(reported), a small twist d behind the first error satisfies
        #     first exp(d) A = first A exp(Ad(A^-1) d),
        # so the first field's Jacobian is carried to the tool by the adjoint of A^-1.
        carried = after.inverse().adjoint() @ self.first.by_coefficients(reported, first)
        return jnp.concatenate([carried, self.second.by_coefficients(reported, second)], axis=-1)
