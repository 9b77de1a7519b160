"""Find by bisection where a lens polynomial reaches a value or stops increasing."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float


def bisected(
    is_below: Callable[[Array], Bool[Array, "*batch"]],
    low: Float[Array, "*batch"],
    high: Float[Array, "*batch"],
    steps: int,
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Return the intervals that contain the solutions after a number of halvings.

    Args:
        is_below: returns for each argument whether it is smaller than its solution.
        low: lower ends of the first intervals.
        high: upper ends.
        steps: number of halvings.
    """

    def halve(_, interval):
        """Return the half of each interval that contains the solution."""
        low, high = interval
        middle = 0.5 * (low + high)
        below = is_below(middle)
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    return jax.lax.fori_loop(0, steps, halve, (low, high))


def end_of_increase(
    derivative: Callable[[Array], Array], grid: Float[np.ndarray, "grid"], otherwise: float
) -> Float[Array, ""]:
    """Return the smallest argument at which a function stops increasing.

    It is not differentiated, because it only limits where a lens is valid.

    Args:
        derivative: of the function, or a positive multiple of it.
        grid: increasing arguments, in which the first change of sign is searched for.
        otherwise: result if the function increases on the whole grid.
    """
    # A grid finds the interval of the derivative's first sign change, and bisection refines it.
    # `argmin` of truth values gives the index of the first False.
    arguments = jnp.asarray(grid)
    rising = derivative(arguments) > 0.0
    first = jnp.argmin(rising)
    low, high = arguments[jnp.maximum(first - 1, 0)], arguments[first]
    low, _ = bisected(lambda middle: derivative(middle) > 0.0, low, high, 50)
    return jax.lax.stop_gradient(jnp.where(jnp.all(rising), otherwise, low))
