"""Propagate a calibration's covariance to anything computed from it, to first order."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...calibration import Calibration
from ...compilation import compiled
from ...engine import Observability, Parameters, Step, parameter_names


@runtime_checkable
class Estimate(Protocol):
    """A calibration with the covariance of its parameters, such as a joint fit or a bound."""

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]

    @property
    def parameter_names(self) -> tuple[str, ...]: ...

    @property
    def observability(self) -> Observability: ...


def std_of(
    estimate: Estimate, function: Callable[[Calibration], Array]
) -> Float[Array, "*numbers"]:
    """Return the standard deviation of every number that a function of the calibration gives.

    It is to first order. For instance, in pixels, where an eye-in-hand camera sees the target from
    a new pose:

        std_of(fit, lambda calibration: calibration.project(base_from_tool, points)[0])

    Args:
        estimate: the result of `fit_joint` or `cramer_rao`.
        function: a differentiable function of one calibration. The same function is compiled once.

    Raises:
        ValueError: the data leave something entirely undetermined; the message names it.
    """
    return jnp.sqrt(_variance(estimate.calibration, function, _independent_steps(estimate)))


def covariance_of(
    estimate: Estimate, function: Callable[[Calibration], Float[Array, "numbers"]]
) -> Float[Array, "numbers numbers"]:
    """Return the covariance of the numbers in a vector that a function gives; see `std_of`."""
    # J P J^T = sum_k (J d_k) (J d_k)^T, with P = sum_k d_k d_k^T.
    spread = _moves(estimate.calibration, function, _independent_steps(estimate))
    return spread.T @ spread


def _independent_steps(estimate: Estimate) -> Float[Array, "directions parameters"]:
    """Return steps of one standard deviation along independent directions of the covariance."""
    if estimate.observability.null:
        words = "; ".join(direction.words for direction in estimate.observability.null)
        raise ValueError(f"the data leave something open, add views or a prior: {words}")
    names = parameter_names(estimate.calibration)
    where = np.array([names.index(name) for name in estimate.parameter_names], dtype=int)
    lengths = np.sqrt(np.diagonal(estimate.covariance))
    # P = L C L with L the standard deviations, C = V diag(s) V^T the correlations, and P = sum_k
    # d_k d_k^T with d_k = sqrt(s_k) L v_k. Correlations instead of the covariance: with pixels
    # beside radians the eigenvectors would lose precision.
    values, vectors = np.linalg.eigh(estimate.covariance / np.outer(lengths, lengths))
    roots = (vectors * np.sqrt(np.maximum(values, 0.0))).T * lengths
    steps = np.zeros((len(roots), len(names)))
    steps[:, where] = roots
    return jnp.asarray(steps)


@compiled
def _variance(
    calibration: Calibration,
    function: Callable[[Calibration], Array],
    steps: Float[Array, "directions parameters"],
) -> Float[Array, "*numbers"]:
    # var(f) = sum_k (J d_k)^2, as P = sum_k d_k d_k^T. One tangent at a time: J is never stored.
    """Return the variances of a function's numbers under steps of one standard deviation each."""
    return sum_of_squares(_by_step(calibration, function), steps)


@compiled
def _moves(
    calibration: Calibration,
    function: Callable[[Calibration], Array],
    steps: Float[Array, "directions parameters"],
) -> Float[Array, "directions *numbers"]:
    """Return the function's first-order changes `J d_k` along each of the steps."""
    _, along = jax.linearize(_by_step(calibration, function), jnp.zeros(steps.shape[1]))
    return jax.lax.map(along, steps)


def _by_step(
    calibration: Calibration, function: Callable[[Calibration], Array]
) -> Callable[[Float[Array, "parameters"]], Array]:
    """Return the function composed with a step of the calibration's common parameters."""
    parameters = Parameters(calibration)

    def of(step: Float[Array, "parameters"]) -> Array:
        return function(parameters.moved(Step(step, jnp.zeros((0, 6))))[0])

    return of


def sum_of_squares(
    function: Callable[[Float[Array, "inputs"]], Array], steps: Float[Array, "directions inputs"]
) -> Float[Array, "*numbers"]:
    """Return the sum of squares of a function's first-order changes along all steps from zero.

    It takes one step at a time, so that memory does not grow with their number.
    """
    value, along = jax.linearize(function, jnp.zeros(steps.shape[1]))

    def add(total: Array, step: Array) -> tuple[Array, None]:
        return total + along(step) ** 2, None

    return jax.lax.scan(add, jnp.zeros_like(value), steps)[0]
