"""The inverse of a lens map by Newton's method, differentiated by the implicit function theorem."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_CONVERGED = 1e-10


def implicit_inverse(
    function: Callable[[Array], Array],
    target: Float[Array, "*batch 2"],
    start: Float[Array, "*batch 2"],
    steps: int = 12,
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """Solve `function(x) = target`, point by point, and say where that worked.

    A lens of one's own writes one direction and has the other from here. Derivatives with respect
    to `target` and to whatever `function` closes over are those of the solution, not of the steps
    that led to it, so they cost one 2 x 2 solve.

    Args:
        function: maps `(*batch, 2)` to `(*batch, 2)`, each point by itself.
        target: the values wanted.
        start: where Newton's method starts; near enough that full steps converge.
        steps: number of Newton steps; convergence is quadratic.

    Returns:
        The solution, and whether the residual there is below 1e-10 and the map does not fold.
    """

    def newton(residual: Callable[[Array], Array], guess: Array) -> Array:
        def step(_, x):
            value = residual(x)
            return x - _solve_pointwise(lambda v: jax.jvp(residual, (x,), (v,))[1], value)

        return jax.lax.fori_loop(0, steps, step, guess)

    solution = jax.lax.custom_root(
        lambda x: function(x) - target, jax.lax.stop_gradient(start), newton, _solve_pointwise
    )
    fixed = jax.lax.stop_gradient(solution)
    error = jnp.max(jnp.abs(function(fixed) - target), axis=-1)
    valid = (error < _CONVERGED) & unfolded(function, fixed)
    return solution, valid


def unfolded(
    function: Callable[[Array], Array], at: Float[Array, "*batch 2"]
) -> Bool[Array, "*batch"]:
    """Where a pointwise map of the plane still grows in every direction: before its first fold."""
    along_x, along_y = _columns(lambda v: jax.jvp(function, (at,), (v,))[1], at)
    determinant = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    return (determinant > 0.0) & (along_x[..., 0] + along_y[..., 1] > 0.0)


def _solve_pointwise(linear: Callable[[Array], Array], value: Array) -> Array:
    """Solve a 2 x 2 system at every point; a singular one gives zero, never NaN."""
    along_x, along_y = _columns(linear, value)
    determinant = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    regular = jnp.abs(determinant) > 1e-12
    scale = jnp.where(regular, 1.0, 0.0) / jnp.where(regular, determinant, 1.0)
    x = along_y[..., 1] * value[..., 0] - along_y[..., 0] * value[..., 1]
    y = along_x[..., 0] * value[..., 1] - along_x[..., 1] * value[..., 0]
    return jnp.stack([scale * x, scale * y], axis=-1)


def _columns(linear: Callable[[Array], Array], like: Array) -> tuple[Array, Array]:
    one, zero = jnp.ones_like(like[..., 0]), jnp.zeros_like(like[..., 0])
    return linear(jnp.stack([one, zero], axis=-1)), linear(jnp.stack([zero, one], axis=-1))
