"""Two error fields at once, where the likelihood cannot decide between them."""

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command
from .field import AbstractField


class CombinedField(AbstractField):
    """Two fields whose errors follow one another at the tool.

    base_from_tool = first.true_pose(reported) @ reported^-1 @ second.true_pose(reported)

    Attributes:
        first: a field of poses.
        second: another, whose groups have other names.
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
        # A twist before the second error is seen from behind it.
        carried = after.inverse().adjoint() @ self.first.by_coefficients(reported, first)
        return jnp.concatenate([carried, self.second.by_coefficients(reported, second)], axis=-1)
