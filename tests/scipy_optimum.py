"""The optimum of a least-squares problem as SciPy finds it, from the same residuals."""

import equinox as eqx
import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares


# The problem is an argument: what a function encloses is a constant, which takes XLA longer, and
# makes a program of each problem.
@eqx.filter_jit
def residuals_and_jacobian(problem, flat):
    """The residuals at a flattened step, and their derivatives by `jacfwd`."""
    _, unravel = ravel_pytree(problem.zero_step())

    def residuals(flat):
        found = ravel_pytree(problem.residuals(unravel(flat)))[0]
        return found, found

    jacobian, found = jax.jacfwd(residuals, has_aux=True)(flat)
    return found, jacobian


def scipy_optimum(problem, start, **options):
    """SciPy's result for the flattened step, and the function that restores a step from it."""
    flat, unravel = ravel_pytree(start)

    # SciPy asks for both at a point that it accepts, one after the other.
    def residuals(x):
        return np.asarray(residuals_and_jacobian(problem, x)[0])

    def jacobian(x):
        return np.asarray(residuals_and_jacobian(problem, x)[1])

    found = least_squares(
        residuals,
        np.asarray(flat),
        jacobian,  # pyright: ignore[reportArgumentType]
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        **options,
    )
    return found, unravel
