"""Differentiate exponentials of rigid transforms: their left Jacobians, and functions of the angle.

Tangents are as in jaxlie: translation (m) first, then rotation (rad). All functions of the angle
are computed together, in few instructions, because a program takes as long to compile as it has
instructions.
"""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SERIES_SQUARED_ANGLE = 0.25
"""Squared angle, rad^2, below which functions are computed from their Taylor series."""

_TERMS = 8
"""Number of terms of a series; the next one of all functions is below 1e-17."""


def _functions_of_angle(
    vectors: Float[Array, "*batch 3"], factors: Float[np.ndarray, "16 functions"]
) -> Float[Array, "*batch functions"]:
    """Return smooth, even functions of the lengths of rotation vectors, rad.

    Each is a Taylor series near zero, where its quotients would lose their digits, and a sum of
    quotients elsewhere.

    Args:
        vectors: the rotation vectors.
        factors: factors of the first powers of the squared angle, and of the quotients `1 / t^2`,
            `1 / t^4`, `cos t / t^2`, `cos t / t^4`, `sin t / t`, `sin t / t^3`, `sin t / t^5` and
            `cos t`, with the angle t; one column for each function.
    """
    square = jnp.sum(vectors**2, axis=-1, keepdims=True)
    is_small = square < _SERIES_SQUARED_ANGLE
    one = jnp.where(is_small, 1.0, 0.0)
    small = jnp.where(is_small, square, 0.0)
    first = jnp.concatenate([one, small, small**2, small**3], axis=-1)
    # The inner `where` keeps the derivative of the branch that is not taken finite.
    t = jnp.sqrt(jnp.where(is_small, 1.0, square))
    inverse = jnp.where(is_small, 0.0, 1.0 / t)
    even = jnp.concatenate([inverse**2, inverse**4], axis=-1)
    sine, cosine = jnp.sin(t) * inverse, jnp.cos(t)
    # Not by `@`, which XLA would split by the terms into many products.
    terms = [first, first * small**4, even, even * cosine, sine, even * sine, (1.0 - one) * cosine]
    columns = factors.reshape((1,) * (vectors.ndim - 1) + factors.shape)
    return jnp.sum(jnp.concatenate(terms, axis=-1)[..., None] * columns, axis=-2)


def _function(term: Callable[[int], float], *quotients: float) -> list[float]:
    """Return the factors of a function, by its Taylor coefficients and its quotients."""
    return [*map(term, range(_TERMS)), *quotients]


def _factorial_series(n: int, weight: Callable[[int], float]) -> Callable[[int], float]:
    """Return the Taylor coefficients `(-1)^k weight(k) / (2 k + n)!`."""
    return lambda k: (-1.0) ** k * weight(k) / math.factorial(2 * k + n)


def _plain(_: int) -> float:
    """Return one, the weight of the series of sine and cosine."""
    return 1.0


_OF_EXPONENTIALS = np.array(
    [
        # (1 - cos t) / t^2 and (t - sin t) / t^3
        _function(_factorial_series(2, _plain), 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        _function(_factorial_series(3, _plain), 1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0),
    ]
).T
"""The factors of the second and third power of a tangent's matrix in its exponential."""

_OF_HALF_ANGLES = np.array(
    [
        # cos t and sin(t) / t
        _function(_factorial_series(0, _plain), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        _function(_factorial_series(1, _plain), 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    ]
).T
"""Real part and factor of the vector part of a rotation's quaternion."""

_OF_LEFT_JACOBIANS = np.array(
    [
        # (4 - t sin t - 4 cos t) / (2 t^2),   (4 t - 5 sin t + t cos t) / (2 t^3),
        # (2 - t sin t - 2 cos t) / (2 t^4),   (2 t - 3 sin t + t cos t) / (2 t^5)
        _function(
            _factorial_series(2, lambda k: 1.0 - k), 2.0, 0.0, -2.0, 0.0, -0.5, 0.0, 0.0, 0.0
        ),
        _function(_factorial_series(3, lambda k: 1.0 - k), 2.0, 0.0, 0.5, 0.0, 0.0, -2.5, 0.0, 0.0),
        _function(
            _factorial_series(4, lambda k: 1.0 + k), 0.0, 1.0, 0.0, -1.0, 0.0, -0.5, 0.0, 0.0
        ),
        _function(_factorial_series(5, lambda k: 1.0 + k), 0.0, 1.0, 0.0, 0.5, 0.0, 0.0, -1.5, 0.0),
    ]
).T
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
    return _as_factors(_functions_of_angle(vectors, _OF_EXPONENTIALS))


def quaternion_exponentials(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4"]:
    """Return the unit quaternions, real part first, of rotation vectors (rad)."""
    half = 0.5 * vectors
    functions = _functions_of_angle(half, _OF_HALF_ANGLES)
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
    a1, a2, a3, a4 = _as_factors(_functions_of_angle(tangent[..., 3:], _OF_LEFT_JACOBIANS))
    identity = np.eye(6).reshape((1,) * (tangent.ndim - 1) + (6, 6))
    # Horner's scheme, with three products of matrices.
    return identity + ad @ (a1 * identity + ad @ (a2 * identity + ad @ (a3 * identity + a4 * ad)))
