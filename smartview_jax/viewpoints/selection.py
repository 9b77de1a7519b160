"""Choosing among candidates: the best next one, again and again, then exchanging one for another.

Reference: Fedorov, Theory of optimal experiments, 1972 (exchange).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..compilation import optimised
from .goals import Goal

FLOOR = 1e-9
"""Of the information of all candidates: makes even one view comparable with another."""

GAIN = 1e-6
"""Of the goal, relative, for which an exchange is worth it."""

SWEEPS = 10
"""Of exchanges over all chosen views, at most."""


@optimised
def greedy(
    information: Float[Array, "candidates free free"],
    known: Float[Array, "free free"],
    goal: Goal,
    count: int,
    allowed: Bool[Array, "candidates"],
) -> Int[Array, "count"]:
    """Indices of candidates, each the one that is best after those before it."""
    start = known + _floor(information, known)

    def add(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Int[Array, ""]]:
        told, open_still = state
        best = jnp.argmin(_values(goal, told[None] + information, open_still))
        return (told + information[best], open_still.at[best].set(False)), best

    return jax.lax.scan(add, (start, allowed), length=count)[1]


@optimised
def exchanged(
    information: Float[Array, "candidates free free"],
    known: Float[Array, "free free"],
    goal: Goal,
    chosen: Int[Array, "count"],
    allowed: Bool[Array, "candidates"],
) -> Int[Array, "count"]:
    """The chosen with each exchanged for what is better in its place, while that gains."""
    start = known + _floor(information, known)

    def place(k: Int[Array, ""], chosen: Int[Array, "count"]) -> Int[Array, "count"]:
        others = start + jnp.sum(information[chosen], axis=0) - information[chosen[k]]
        free = allowed.at[chosen].set(False).at[chosen[k]].set(True)
        values = _values(goal, others[None] + information, free)
        best = jnp.argmin(values)
        better = values[best] < (1.0 - GAIN) * values[chosen[k]]
        return chosen.at[k].set(jnp.where(better, best, chosen[k]))

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        before, _, sweeps = state
        after = jax.lax.fori_loop(0, len(chosen), place, before)
        return after, jnp.any(after != before), sweeps + 1

    def going_on(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        return state[1] & (state[2] < SWEEPS)

    return jax.lax.while_loop(going_on, sweep, (chosen, jnp.array(True), jnp.array(0)))[0]


@optimised
def curve(
    information: Float[Array, "views free free"], known: Float[Array, "free free"], goal: Goal
) -> Float[Array, "views"]:
    """The goal after one view, after two, and so on; infinite where that leaves something open."""
    values = jax.lax.map(goal, known[None] + jnp.cumsum(information, axis=0))
    return jnp.where(jnp.isfinite(values), values, jnp.inf)


def views_needed(
    values: Float[Array, "views"], gain: float = 0.05, wanted: float | None = None
) -> int:
    """After how many views to stop: at the wanted error, or where one more gains too little.

    Args:
        values: of a `curve`.
        gain: relative, of one more view, that is worth taking it.
        wanted: by which to stop even if more would gain.

    Returns:
        A number from 1; that of all views where none of them ends it.
    """
    for k, value in enumerate(values, start=1):
        if wanted is not None and value <= wanted:
            return k
        if k < len(values) and jnp.isfinite(value) and values[k] > (1.0 - gain) * value:
            return k
    return len(values)


def _values(
    goal: Goal, information: Float[Array, "candidates free free"], free: Bool[Array, "candidates"]
) -> Float[Array, "candidates"]:
    """The goal with each candidate; infinite for those that are not free."""
    values = jax.vmap(goal)(information)
    return jnp.where(free & jnp.isfinite(values), values, jnp.inf)


def _floor(
    information: Float[Array, "candidates free free"], known: Float[Array, "free free"]
) -> Float[Array, "free free"]:
    return FLOOR * jnp.diag(jnp.diagonal(known + jnp.sum(information, axis=0)))
