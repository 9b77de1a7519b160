"""Propagate a calibration's covariance to anything computed from it, to first order."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...calibration import Calibration
from ...engine import Observability, Parameters, Step, covariance_factor, parameter_names
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled


@runtime_checkable
class CalibrationEstimate(Protocol):
    """A calibration with the covariance of its parameters, such as a joint fit or a bound."""

    @property
    def calibration(self) -> Calibration: ...

    @property
    def covariance(self) -> Float[np.ndarray, "free free"]: ...

    @property
    def parameter_names(self) -> tuple[str, ...]: ...

    @property
    def observability(self) -> Observability: ...


def std_of(
    estimate: CalibrationEstimate, function: Callable[[Calibration], Array]
) -> Float[Array, "*numbers"]:
    """Return the standard deviation of every number in the value of a function of the calibration.

    To first order. For instance, of the target's pixels for an eye-in-hand camera at a new pose:

        std_of(fit, lambda calibration: calibration.project(base_from_tool, points)[0])

    Args:
        estimate: the result of `fit_joint` or `cramer_rao`.
        function: a differentiable function of one calibration. The same function is compiled once.

    Raises:
        ValueError: a combination of parameters is undetermined; the message names it.

    For example:

        >>> def target_position(calibration):
        ...     return calibration.base_from_world.translation()
        >>> print(np.round(1e3 * sv.std_of(fit.joint, target_position), 2), "mm")
        [0.06 0.05 0.15] mm
    """
    return _standard_deviation(estimate.calibration, function, covariance_root(estimate))


def covariance_of(
    estimate: CalibrationEstimate, function: Callable[[Calibration], Float[Array, "numbers"]]
) -> Float[Array, "numbers numbers"]:
    """Return the covariance of the numbers in a function's value, a vector; see `std_of`."""
    # J P J^T = sum_k (J d_k) (J d_k)^T, with P = sum_k d_k d_k^T. The rows of `changes` are J d_k.
    changes = _directional_derivatives(estimate.calibration, function, covariance_root(estimate))
    return changes.T @ changes


def covariance_root(estimate: CalibrationEstimate) -> Float[Array, "directions parameters"]:
    """Return steps of one standard deviation along independent directions of the covariance.

    The columns are all parameters of the calibration, in the order of `engine.parameter_names`,
    with zeros for parameters that were not fitted.

    Raises:
        ValueError: a combination of parameters is undetermined; the message names it.
    """
    if estimate.observability.null_directions:
        descriptions = "; ".join(
            direction.description for direction in estimate.observability.null_directions
        )
        raise ValueError(f"the data do not determine: {descriptions}; add views or a prior")
    names = parameter_names(estimate.calibration)
    indices = np.array([names.index(name) for name in estimate.parameter_names], dtype=int)
    # P = R R^T = sum_k d_k d_k^T, with d_k the columns of R.
    roots = covariance_factor(np.asarray(estimate.covariance)).T
    # Held parameters have no uncertainty: their entries stay zero.
    steps = np.zeros((len(roots), len(names)))
    steps[:, indices] = roots
    return to_device(steps)


@compiled
def _standard_deviation(
    calibration: Calibration,
    function: Callable[[Calibration], Array],
    steps: Float[Array, "directions parameters"],
) -> Float[Array, "*numbers"]:
    """Return a function's standard deviations, from steps of one standard deviation each."""
    # var(f) = sum_k (J d_k)^2, since P = sum_k d_k d_k^T. One tangent at a time, without storing J.
    return jnp.sqrt(sum_of_squared_derivatives(_function_of_step(calibration, function), steps))


@compiled
def _directional_derivatives(
    calibration: Calibration,
    function: Callable[[Calibration], Array],
    steps: Float[Array, "directions parameters"],
) -> Float[Array, "directions *numbers"]:
    """Return the function's first-order changes `J d_k` along each of the steps."""
    _, jvp = jax.linearize(_function_of_step(calibration, function), jnp.zeros(steps.shape[1]))
    return jax.lax.map(jvp, steps)


def _function_of_step(
    calibration: Calibration, function: Callable[[Calibration], Array]
) -> Callable[[Float[Array, "parameters"]], Array]:
    """Return the function composed with a step of the calibration's common parameters."""
    parameters = Parameters(calibration)

    # No pose corrections: the function depends only on the common parameters.
    def composed(step: Float[Array, "parameters"]) -> Array:
        return function(parameters.retract(Step(step, jnp.zeros((0, 6))))[0])

    return composed


def sum_of_squared_derivatives(
    function: Callable[[Float[Array, "inputs"]], Array], steps: Float[Array, "directions inputs"]
) -> Float[Array, "*numbers"]:
    """Return the sum of squares of a function's first-order changes along all steps from zero.

    One step at a time, so that memory does not grow with their number.
    """
    value, jvp = jax.linearize(function, jnp.zeros(steps.shape[1]))

    def add_squared(total: Array, step: Array) -> tuple[Array, None]:
        return total + jvp(step) ** 2, None

    return jax.lax.scan(add_squared, jnp.zeros_like(value), steps)[0]
