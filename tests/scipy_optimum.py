"""The optimum of a least-squares problem as SciPy finds it, from the same residuals."""

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares


def scipy_optimum(problem, start, **options):
    """SciPy's result for the flattened step, and the function that restores a step from it."""
    flat, unravel = ravel_pytree(start)
    residuals = jax.jit(lambda x: ravel_pytree(problem.residuals(unravel(x)))[0])
    jacobian = jax.jit(jax.jacfwd(residuals))
    found = least_squares(
        residuals,
        np.asarray(flat),
        lambda x: np.asarray(jacobian(x)),  # pyright: ignore[reportArgumentType]
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
        **options,
    )
    return found, unravel
