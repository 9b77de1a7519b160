"""How well anything computed from a calibration is known: covariance, carried through the model."""

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
    """A calibration and how well its parameters are known: a joint fit, or a bound."""

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]

    @property
    def parameter_names(self) -> tuple[str, ...]: ...

    @property
    def observability(self) -> Observability: ...


def std_of(
    estimate: Estimate, function: Callable[[Calibration], Array]
) -> Float[Array, "*numbers"]:
    """Standard deviation of every number that a function of the calibration gives, to first order.

    For instance, in pixels, where the camera on a hand sees the target from a new pose:

        std_of(fit, lambda calibration: calibration.project(base_from_tool, points)[0])

    Args:
        estimate: what `fit_joint` or `cramer_rao` found.
        function: differentiable; works on one calibration. The same function is compiled once.

    Raises:
        ValueError: the data leave something entirely open; the message says what.
    """
    return jnp.sqrt(_variance(estimate.calibration, function, _independent_steps(estimate)))


def covariance_of(
    estimate: Estimate, function: Callable[[Calibration], Float[Array, "numbers"]]
) -> Float[Array, "numbers numbers"]:
    """Covariance of the numbers in the row that a function gives; otherwise as `std_of`."""
    spread = _moves(estimate.calibration, function, _independent_steps(estimate))
    return spread.T @ spread


def _independent_steps(estimate: Estimate) -> Float[Array, "directions parameters"]:
    """Steps of one standard deviation along each of the independent directions of uncertainty."""
    if estimate.observability.null:
        words = "; ".join(direction.words for direction in estimate.observability.null)
        raise ValueError(f"the data leave something open, add views or a prior: {words}")
    names = parameter_names(estimate.calibration)
    where = np.array([names.index(name) for name in estimate.parameter_names], dtype=int)
    lengths = np.sqrt(np.diagonal(estimate.covariance))
    # Of the correlations: pixels beside radians would cost the eigenvectors their digits.
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
    return sum_of_squares(_by_step(calibration, function), steps)


@compiled
def _moves(
    calibration: Calibration,
    function: Callable[[Calibration], Array],
    steps: Float[Array, "directions parameters"],
) -> Float[Array, "directions *numbers"]:
    _, along = jax.linearize(_by_step(calibration, function), jnp.zeros(steps.shape[1]))
    return jax.lax.map(along, steps)


def _by_step(
    calibration: Calibration, function: Callable[[Calibration], Array]
) -> Callable[[Float[Array, "parameters"]], Array]:
    parameters = Parameters(calibration)

    def of(step: Float[Array, "parameters"]) -> Array:
        return function(parameters.moved(Step(step, jnp.zeros((0, 6))))[0])

    return of


def sum_of_squares(
    function: Callable[[Float[Array, "inputs"]], Array], steps: Float[Array, "directions inputs"]
) -> Float[Array, "*numbers"]:
    """Of a function's first-order changes along all steps from zero, one step at a time."""
    value, along = jax.linearize(function, jnp.zeros(steps.shape[1]))

    def add(total: Array, step: Array) -> tuple[Array, None]:
        return total + along(step) ** 2, None

    return jax.lax.scan(add, jnp.zeros_like(value), steps)[0]
