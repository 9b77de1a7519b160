"""Evaluate the same formulas with NumPy directly, or with JAX to differentiate and batch them.

NumPy evaluates a formula on small arrays in less time than JAX needs to compile a program for it.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from .double_precision import require_double_precision

AnyArray: TypeAlias = Array | np.ndarray
"""A JAX or NumPy array."""

AnyScalar: TypeAlias = Float[AnyArray, ""] | float
"""A number: a JAX or NumPy array without axes, or a `float`, which includes NumPy's scalars."""


_HOST_TYPES = (np.ndarray, np.generic, float)


def array_namespace(*trees: Any) -> ModuleType:
    """Return `jax.numpy` if any array in the arguments is a JAX array, otherwise `numpy`."""
    # Most arguments are single arrays, which take a tenth of the time that a pytree takes.
    for tree in trees:
        if not isinstance(tree, _HOST_TYPES):
            break
    else:
        return np
    is_jax = any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees))
    return jnp if is_jax else np


def to_device(array: AnyArray | float | list[float]) -> Array:
    """Return a NumPy array as a JAX array; `jnp.asarray` would compile a program for each shape."""
    require_double_precision()
    return jax.device_put(np.asarray(array))


def to_device_together(arrays: Any) -> Any:
    """Return a pytree of numbers and NumPy arrays as JAX arrays.

    One transfer of all takes hardly longer than one of a single array.
    """
    require_double_precision()
    return jax.device_put(jax.tree.map(np.asarray, arrays))


def stacked_on_device(trees: Sequence[Any]) -> Any:
    """Return pytrees of arrays as one, with JAX arrays that have the trees as their first axis."""
    return jax.tree.map(lambda *x: to_device(np.stack([np.asarray(y) for y in x])), *trees)


def where_tree(condition: Bool[Array, ""], if_true: Any, if_false: Any) -> Any:
    """Return the first of two pytrees where a scalar condition holds, else the second."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)


def as_float_array(value: ArrayLike | Sequence[Any]) -> Float[Array, "..."]:
    """Return a number, an array or a sequence of numbers as a JAX array of double precision.

    Nothing is compiled for numbers and NumPy arrays.
    """
    require_double_precision()
    if isinstance(value, jax.Array):
        return jnp.asarray(value, dtype=float)
    return jax.device_put(np.asarray(value, dtype=float))
