"""Differentiate exponentials of rigid transforms: their left Jacobians, and functions of the angle.

Tangents are as in jaxlie: translation (m) first, then rotation (rad). All functions of the angle
are computed together, in few instructions, because a program takes as long to compile as it has
instructions.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SERIES_SQUARED_ANGLE = 0.25
"""Squared angle, rad^2, below which functions are computed from their Taylor series."""

_TERMS = 8
"""Number of terms of a series; the next one of all functions is below 1e-17."""


class _AngleFunctions(NamedTuple):
    """Some smooth, even functions of an angle t that are quotients with powers of t.

    Attributes:
        series: Taylor coefficients, one row for each power of the squared angle.
        numerators: coefficients of the numerators, one row each for 1, t, sin t, t sin t, cos t and
            t cos t.
        powers: exponent of t in each denominator.
    """

    series: Float[np.ndarray, "terms functions"]
    numerators: Float[np.ndarray, "6 functions"]
    powers: Float[np.ndarray, "functions"]

    def at(self, vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch functions"]:
        """Return the functions at the lengths of rotation vectors, rad."""
        axes = (1,) * (vectors.ndim - 1)
        series, numerators, powers = (x.reshape(x.shape[:-1] + axes + x.shape[-1:]) for x in self)
        square = jnp.sum(vectors**2, axis=-1, keepdims=True)
        is_small = square < _SERIES_SQUARED_ANGLE
        # Near zero, where the quotients lose their digits, the series are used.
        near_zero = series[-1]
        for coefficients in series[-2::-1]:
            near_zero = coefficients + square * near_zero
        # The inner `where` keeps the derivative of the branch that is not taken finite.
        t = jnp.sqrt(jnp.where(is_small, 1.0, square))
        plain, by_sine, by_cosine = (
            even + t * odd for even, odd in zip(numerators[::2], numerators[1::2], strict=True)
        )
        quotients = (plain + by_sine * jnp.sin(t) + by_cosine * jnp.cos(t)) / t**powers
        return jnp.where(is_small, near_zero, quotients)


def _series(n: int, weight: Callable[[int], float] = lambda _: 1.0) -> list[float]:
    """Return the Taylor coefficients `(-1)^k weight(k) / (2 k + n)!`."""
    return [(-1.0) ** k * weight(k) / math.factorial(2 * k + n) for k in range(_TERMS)]


_OF_EXPONENTIALS = _AngleFunctions(
    # (1 - cos t) / t^2 and (t - sin t) / t^3
    np.array([_series(2), _series(3)]).T,
    np.array([(1.0, 0.0, 0.0, 0.0, -1.0, 0.0), (0.0, 1.0, -1.0, 0.0, 0.0, 0.0)]).T,
    np.array([2.0, 3.0]),
)
"""The factors of the second and third power of a tangent's matrix in its exponential."""

_OF_HALF_ANGLES = _AngleFunctions(
    # cos t and sin(t) / t
    np.array([_series(0), _series(1)]).T,
    np.array([(0.0, 0.0, 0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)]).T,
    np.array([0.0, 1.0]),
)
"""Real part and factor of the vector part of a rotation's quaternion."""

_OF_LEFT_JACOBIANS = _AngleFunctions(
    # (4 - t sin t - 4 cos t) / (2 t^2),   (4 t - 5 sin t + t cos t) / (2 t^3),
    # (2 - t sin t - 2 cos t) / (2 t^4),   (2 t - 3 sin t + t cos t) / (2 t^5)
    np.array(
        [
            *(_series(n, lambda k: 1.0 - k) for n in (2, 3)),
            *(_series(n, lambda k: 1.0 + k) for n in (4, 5)),
        ]
    ).T,
    np.array(
        [
            (2.0, 0.0, 0.0, -0.5, -2.0, 0.0),
            (0.0, 2.0, -2.5, 0.0, 0.0, 0.5),
            (1.0, 0.0, 0.0, -0.5, -1.0, 0.0),
            (0.0, 1.0, -1.5, 0.0, 0.0, 0.5),
        ]
    ).T,
    np.array([2.0, 3.0, 4.0, 5.0]),
)
"""The factors of `ad` to `ad^4` in `se3_left_jacobian`."""

_COMMUTATORS = np.zeros((6, 6, 6))
"""Matrices of the commutators with the six unit tangents."""
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    for _generator, _rows, _columns in ((_k, 0, 3), (3 + _k, 0, 0), (3 + _k, 3, 3)):
        _COMMUTATORS[_generator, _rows + _j, _columns + _i] = 1.0
        _COMMUTATORS[_generator, _rows + _i, _columns + _j] = -1.0


def _as_factors(functions: Float[Array, "*batch functions"]) -> tuple[Array, ...]:
    """Return each function as a factor of matrices, `(*batch, 1, 1)`."""
    return tuple(functions[..., k, None, None] for k in range(functions.shape[-1]))


def exponential_factors(
    vectors: Float[Array, "*batch 3"],
) -> tuple[Float[Array, "*batch 1 1"], ...]:
    """Return `(1 - cos t) / t^2` and `(t - sin t) / t^3` of the lengths t of rotation vectors."""
    return _as_factors(_OF_EXPONENTIALS.at(vectors))


def quaternion_exponentials(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Return the unit quaternions, real part first, of rotation vectors (rad)."""
    half = 0.5 * vectors
    functions = _OF_HALF_ANGLES.at(half)
    return jnp.concatenate([functions[..., :1], functions[..., 1:] * half], axis=-1)


def se3_left_jacobian(tangent: Float[Array, "*batch 6"]) -> Float[Array, "*batch 6 6"]:
    """Return the left Jacobian J of `SE3.exp` at tangents.

    For small d, `exp(tangent + d) = exp(J d) @ exp(tangent)`. The last three rows and columns of J
    are the left Jacobian of `SO3.exp`.

    Reference: Barfoot, State estimation for robotics, 2017, section 7.1.
    """
    # J = sum_k ad^k / (k + 1)!, with ad the matrix of [tangent, .]. With the angle t,
    # ad^5 = -2 t^2 ad^3 - t^4 ad, so the series ends at the fourth power:
    #     J = I + a1 ad + a2 ad^2 + a3 ad^3 + a4 ad^4
    ad = jnp.einsum("...k,kij->...ij", tangent, _COMMUTATORS)
    a1, a2, a3, a4 = _as_factors(_OF_LEFT_JACOBIANS.at(tangent[..., 3:]))
    identity = jnp.asarray(np.eye(6).reshape((1,) * (tangent.ndim - 1) + (6, 6)))
    # Horner's scheme, with three products of matrices.
    return identity + ad @ (a1 * identity + ad @ (a2 * identity + ad @ (a3 * identity + a4 * ad)))
