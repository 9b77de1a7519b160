"""Invert a lens map: the plane by Newton's method, its radius by bisection.

Derivatives are by the implicit function theorem, not through the iterations.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_RESIDUAL_TOLERANCE = 1e-10
"""Largest accepted residual of the inverse, in units of the normalised image plane."""


def implicit_inverse(
    function: Callable[[Array], Array],
    target: Float[Array, "*batch 2"],
    start: Float[Array, "*batch 2"],
    steps: int = 12,
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """Solve `function(x) = target` for each point and report where the solution is valid.

    A lens model that defines one direction obtains the other one here. Derivatives with respect to
    `target`, and to any parameter that `function` closes over, are computed at the solution and not
    through the iterations, so that they cost one 2 x 2 solve.

    Args:
        function: maps `(*batch, 2)` to `(*batch, 2)`, each point independently.
        target: the wanted values.
        start: starting points of Newton's method, close enough that full steps converge.
        steps: number of Newton steps; convergence is quadratic.

    Returns:
        The solution, and whether its residual is below 1e-10 and the map is not folded there.
    """
    # Newton:    x <- x - (df/dx)^-1 (f(x) - target), with full steps, for each point.
    # Implicit:  df/dx dx = dtarget - df/dp dp   at the solution, for the parameters p of f.

    def newton(residual: Callable[[Array], Array], guess: Array) -> Array:
        """Return the solution of `residual(x) = 0` after the fixed number of Newton steps."""

        def step(_, x):
            """Return the points after one Newton step."""
            value = residual(x)
            return x - _solve_pointwise(lambda v: jax.jvp(residual, (x,), (v,))[1], value)

        return jax.lax.fori_loop(0, steps, step, guess)

    solution = jax.lax.custom_root(
        lambda x: function(x) - target, jax.lax.stop_gradient(start), newton, _solve_pointwise
    )
    # Whether a solution is valid is not differentiated.
    constant_solution = jax.lax.stop_gradient(solution)
    error = jnp.max(jnp.abs(function(constant_solution) - target), axis=-1)
    valid = (error < _RESIDUAL_TOLERANCE) & is_unfolded(function, constant_solution)
    return solution, valid


def is_unfolded(
    function: Callable[[Array], Array], points: Float[Array, "*batch 2"]
) -> Bool[Array, "*batch"]:
    """Return where a pointwise map of the plane is not folded.

    There its Jacobian J has a positive determinant and a positive trace. Both hold at the identity
    map, and the determinant vanishes at the first fold.
    """
    # det J > 0 and trace J > 0: without the trace, a map that is mirrored in both axes would pass.
    column_x, column_y = _matrix_columns(lambda v: jax.jvp(function, (points,), (v,))[1], points)
    determinant = column_x[..., 0] * column_y[..., 1] - column_x[..., 1] * column_y[..., 0]
    return (determinant > 0.0) & (column_x[..., 0] + column_y[..., 1] > 0.0)


def _solve_pointwise(linear: Callable[[Array], Array], value: Array) -> Array:
    """Solve a 2 x 2 system at every point; the solution of a singular one is zero, never NaN."""
    # Cramer's rule for x a + y b = v:   x = (v x b) / (a x b),   y = (a x v) / (a x b).
    # Without NaN, a point without a solution does not spoil the derivatives of the others.
    column_x, column_y = _matrix_columns(linear, value)
    determinant = column_x[..., 0] * column_y[..., 1] - column_x[..., 1] * column_y[..., 0]
    regular = jnp.abs(determinant) > 1e-12
    scale = jnp.where(regular, 1.0, 0.0) / jnp.where(regular, determinant, 1.0)
    x = column_y[..., 1] * value[..., 0] - column_y[..., 0] * value[..., 1]
    y = column_x[..., 0] * value[..., 1] - column_x[..., 1] * value[..., 0]
    return jnp.stack([scale * x, scale * y], axis=-1)


def _matrix_columns(linear: Callable[[Array], Array], like: Array) -> tuple[Array, Array]:
    """Return the two columns of a linear pointwise map of the plane, at every point."""
    ones, zeros = jnp.ones_like(like[..., 0]), jnp.zeros_like(like[..., 0])
    return linear(jnp.stack([ones, zeros], axis=-1)), linear(jnp.stack([zeros, ones], axis=-1))


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
