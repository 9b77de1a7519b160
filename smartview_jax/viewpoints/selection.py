"""Select views from candidates: greedy selection, then exchange of single views.

Reference: Fedorov, Theory of optimal experiments, 1972 (exchange).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..compilation import optimised
from .goals import Goal

FLOOR = 1e-9
"""Fraction of the information of all candidates that is added before selection (no unit).

It makes the goal finite, and comparable, for a single view.
"""

GAIN = 1e-6
"""Relative decrease of the goal for which an exchange is worthwhile."""

SWEEPS = 10
"""Largest number of exchange passes over all chosen views."""


@optimised
def greedy(
    information: Float[Array, "candidates free free"],
    known: Float[Array, "free free"],
    goal: Goal,
    count: int,
    allowed: Bool[Array, "candidates"],
) -> Int[Array, "count"]:
    """Return indices of candidates, each the best addition to those before it."""
    start = known + _floor(information, known)

    # Information adds up, so F + F_c of every candidate c is one sum, and per step
    #     c* = argmin over allowed c of goal(F + F_c),    F <- F + F_c*
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
    """Return the selection with each view replaced by a better candidate, as long as that helps."""
    start = known + _floor(information, known)

    def place(k: Int[Array, ""], chosen: Int[Array, "count"]) -> Int[Array, "count"]:
        # Information without the view that may be replaced:
        #     F_others = F_0 + sum over chosen F_c - F_k
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
    """Return the goal after one view, two views, and so on; infinite where it is undetermined."""
    values = jax.lax.map(goal, known[None] + jnp.cumsum(information, axis=0))
    return jnp.where(jnp.isfinite(values), values, jnp.inf)


def views_needed(
    values: Float[Array, "views"], gain: float = 0.05, wanted: float | None = None
) -> int:
    """Return after how many views to stop, at the wanted value or at a small gain per view.

    Args:
        values: values of a `curve`.
        gain: relative decrease by one more view that is worth taking it.
        wanted: value of the goal at which to stop even if more views would gain.

    Returns:
        A number from 1; the number of all views if no criterion stops earlier.
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
    """Return the goal with each candidate added; infinite for candidates that are not available."""
    values = jax.vmap(goal)(information)
    return jnp.where(free & jnp.isfinite(values), values, jnp.inf)


def _floor(
    information: Float[Array, "candidates free free"], known: Float[Array, "free free"]
) -> Float[Array, "free free"]:
    """Return a small diagonal matrix in proportion to the information of all candidates."""
    return FLOOR * jnp.diag(jnp.diagonal(known + jnp.sum(information, axis=0)))
