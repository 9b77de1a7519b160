"""Pad small data sets to a few sizes, so that data sets of about the same size share programs.

XLA compiles a program for the shapes of its arguments. For a small data set compiling takes seconds
and running takes milliseconds, so a second data set with one more view should reuse the program.
Padding repeats the last view and the last point; no padded point is visible. Padded arrays stay on
the host: a program takes NumPy arrays too, and to make a JAX array of each one takes as long as all
of the program's own work.
"""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Int

from .array_namespace import to_device

MAX_PADDED_OBSERVATIONS = 5_000
"""Largest number of observations, including padding, up to which a data set is padded.

Larger data sets use optimised programs (`compilation.MIN_OPTIMISED_ELEMENTS`) and run so long that
padding would cost noticeable time.
"""

MIN_PADDED_COUNT = 8
"""Smallest number of views, and of points, after padding."""

MIN_PADDED_VIEWS = 64
"""Smallest number of views, after padding, of programs that compute little for each view."""

_Tree = TypeVar("_Tree")


def padded_counts(views: int, points: int = 1) -> tuple[int, int]:
    """Return the numbers of views and of points to pad a data set to.

    They are powers of two, at least 8; for a large data set the given numbers are returned.
    """
    padded = power_of_two_from(views, MIN_PADDED_COUNT), power_of_two_from(points, MIN_PADDED_COUNT)
    return padded if padded[0] * padded[1] <= MAX_PADDED_OBSERVATIONS else (views, points)


def power_of_two_from(count: int, smallest: int = 1) -> int:
    """Return the smallest power of two that is no smaller than two numbers."""
    return 1 << (max(count, smallest) - 1).bit_length()


def repeat_last(arrays: _Tree, count: int, axis: int = 0) -> _Tree:
    """Append copies of the last entry to arrays, on the host, until they have `count` entries.

    Args:
        arrays: pytree of arrays; empty arrays are unchanged.
        count: number of entries wanted; arrays with as many or more are returned unchanged, all
            others become NumPy arrays.
        axis: axis of the entries.
    """
    return jax.tree.map(lambda x: _repeat_last(x, count, axis), arrays)


def _repeat_last(array: Any, count: int, axis: int) -> Any:
    """Append copies of the last entry to one array."""
    missing = count - array.shape[axis]
    if missing <= 0 or array.shape[axis] == 0:
        return array
    return np.asarray(array).take(_last_repeated(array.shape[axis], count), axis)


@functools.cache
def _last_repeated(size: int, count: int) -> Int[np.ndarray, "count"]:
    """Return the indices of so many entries, the last of `size` ones again and again."""
    return np.minimum(np.arange(count), size - 1)


def over_padded_views(
    program: Callable[[Any], Any], by_view: Any, at_least: int = MIN_PADDED_VIEWS
) -> Any:
    """Run a program on arrays by views, padded in their number, and return its result on the host.

    Args:
        program: maps arrays whose first axis is the views to such arrays.
        by_view: pytree of its arguments with at least one array.
        at_least: number of views, after padding, of few views; the default is for programs that
            compute little for each view.
    """
    views = len(jax.tree.leaves(by_view)[0])
    padded = repeat_last(by_view, padded_counts(max(views, at_least))[0])
    return jax.tree.map(lambda x: np.asarray(x)[:views], program(padded))


def in_batches(program: Callable[[Any], Any], rows: Any, size: int, threads: int = 1) -> Any:
    """Return what a program makes of rows, on the host, run with a fixed number of rows at a time.

    So one program serves any number of rows, with bounded memory.

    Args:
        program: from arrays of so many rows to a pytree of arrays with as many.
        rows: pytree of arrays with one length; the last batch is padded by copies of its last row,
            or by zeros without any.
        size: number of rows in a batch.
        threads: number of batches that are computed at the same time, after the first, which
            compiles the program if necessary.
    """
    host = jax.tree.map(np.asarray, rows)
    count = len(jax.tree.leaves(host)[0])

    def of_batch(start: int) -> Any:
        batch = jax.tree.map(lambda x: x[start : start + size], host)
        if count == 0:
            batch = jax.tree.map(lambda x: np.zeros((size, *x.shape[1:]), x.dtype), host)
        results = program(jax.device_put(repeat_last(batch, size)))
        return jax.tree.map(lambda x: np.asarray(x)[: count - start], results)

    # One batch at least, which tells the shapes of the results.
    first, *others = range(0, max(count, 1), size)
    results = [of_batch(first)]
    if others and threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            results += pool.map(of_batch, others)
    else:
        results += map(of_batch, others)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *results)


def without_padding(arrays: _Tree, *counts: int) -> _Tree:
    """Return the first entries of arrays along their first axes, copied only if there are more.

    Args:
        arrays: pytree of arrays.
        counts: number of entries along the first axis, and so on.
    """
    return jax.tree.map(lambda x: _first_entries(x, counts), arrays)


def host_without_padding(arrays: _Tree, *counts: int) -> _Tree:
    """Return what `without_padding` does as NumPy arrays, which takes a tenth of the time."""
    first = tuple(slice(count) for count in counts)
    return jax.tree.map(lambda x: np.asarray(x)[first], arrays)


def _first_entries(array: Any, counts: tuple[int, ...]) -> Any:
    """Return the first entries of one array."""
    if all(size <= count for size, count in zip(array.shape, counts, strict=False)):
        return array
    return to_device(np.asarray(array)[tuple(slice(count) for count in counts)])
