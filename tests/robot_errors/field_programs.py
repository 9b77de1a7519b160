"""What robot error fields are asked, compiled as a whole.

Operation by operation it would take a program for each, and far longer. Poses come in twelves, so
that all tests of a field share its programs.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array

from smartview_jax.geometry import host_logarithms, host_matrices
from smartview_jax.robot_errors import AbstractField, RobotError
from smartview_jax.robots import Command


@eqx.filter_jit
def actual_pose(error: RobotError, reported: SE3 | Command) -> SE3:
    """Return where the tool is."""
    return error.actual_pose(reported)


@eqx.filter_jit
def tool_command(error: RobotError, actual: SE3) -> SE3:
    """Return the pose to command, for it to be at another."""
    return error.command(actual).base_from_tool


@eqx.filter_jit
def own_jacobian(error: RobotError, reported: SE3 | Command) -> Array:
    """Return the twist of each coefficient, as the field computes it."""
    return error.jacobian(reported)


@eqx.filter_jit
def both_jacobians(
    field: AbstractField, reported: Command, coefficients: Array
) -> tuple[Array, Array]:
    """Return the derivative as the field computes it, and as any field inherits it."""
    own = field.jacobian(reported, coefficients)
    return own, AbstractField.jacobian(field, reported, coefficients)


@eqx.filter_jit
def motion_of_tool(error: RobotError, reported: SE3) -> Array:
    """Return the motion from reported to actual poses, as fits compute it."""
    prepared = error.field.prepare(Command(reported))
    return error.field.prepared_error(prepared, error.coefficients, reported.inverse())


def motion_between(first: SE3, second: SE3) -> np.ndarray:
    """Return the twist from one pose to another, by NumPy."""
    return host_logarithms(np.linalg.inv(host_matrices(first)) @ host_matrices(second))


def twists_by_differences(error: RobotError, reported: SE3 | Command) -> np.ndarray:
    """Return the twist of each coefficient by differences of fourth order."""
    here, step = actual_pose(error, reported), 1e-3

    def moved(k: int, steps: int) -> np.ndarray:
        coefficients = np.array(error.coefficients)
        coefficients[k] += steps * step
        there = actual_pose(RobotError(error.field, jnp.asarray(coefficients)), reported)
        return motion_between(here, there)

    twists = [
        (moved(k, -2) - 8.0 * moved(k, -1) + 8.0 * moved(k, 1) - moved(k, 2)) / (12.0 * step)
        for k in range(error.field.size)
    ]
    return np.stack(twists, axis=-1)
