"""How well anything computed from a calibration is known: covariance, carried through the model."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..joint import Observability
from ..joint.parameters import Parameters, Step, parameter_names


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
    return jnp.sqrt(jnp.sum(_spread(estimate, function) ** 2, axis=0))


def covariance_of(
    estimate: Estimate, function: Callable[[Calibration], Float[Array, "numbers"]]
) -> Float[Array, "numbers numbers"]:
    """Covariance of the numbers in the row that a function gives; otherwise as `std_of`."""
    spread = _spread(estimate, function)
    return spread.T @ spread


def _spread(
    estimate: Estimate, function: Callable[[Calibration], Array]
) -> Float[Array, "directions *numbers"]:
    """How far the function moves along each of the independent directions of uncertainty."""
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
    return _moves(estimate.calibration, function, jnp.asarray(steps))


@eqx.filter_jit
def _moves(
    calibration: Calibration,
    function: Callable[[Calibration], Array],
    steps: Float[Array, "directions parameters"],
) -> Float[Array, "directions *numbers"]:
    parameters = Parameters(calibration)

    def of(step: Float[Array, "parameters"]) -> Array:
        return function(parameters.moved(Step(step, jnp.zeros((0, 6))))[0])

    _, along = jax.linearize(of, jnp.zeros(steps.shape[1]))
    return jax.lax.map(along, steps)
