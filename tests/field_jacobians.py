"""Compute the derivative of a robot error field in two ways."""

import equinox as eqx
from jaxtyping import Array

from smartview_jax.robot_errors import AbstractField
from smartview_jax.robots import Command


@eqx.filter_jit
def both_jacobians(
    field: AbstractField, reported: Command, coefficients: Array
) -> tuple[Array, Array]:
    """Return the derivative as the field computes it, and as any field inherits it."""
    own = field.jacobian(reported, coefficients)
    return own, AbstractField.jacobian(field, reported, coefficients)
