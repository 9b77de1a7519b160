"""Select views from candidates: greedy selection, then exchange of single views.

Reference: Fedorov, Theory of optimal experiments, 1972 (exchange).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..geometry import host_matrices
from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.compilation import compiled_optimised
from .optimality_criteria import OptimalityCriterion

REGULARISATION_FRACTION = 1e-9
"""Fraction of the information of all candidates that is added before selection (no unit).

It makes the criterion finite, and comparable, for a single view.
"""

MIN_RELATIVE_DECREASE = 1e-6
"""Smallest relative decrease of the criterion for which an exchange is made."""

MAX_EXCHANGE_SWEEPS = 10
"""Largest number of exchange passes over all chosen views."""


def best_candidates(
    information: Float[Array, "candidates free free"],
    prior_information: Float[Array, "free free"],
    criterion: OptimalityCriterion,
    count: int,
    allowed: Bool[Array, "candidates"],
    say: Callable[[str], None],
) -> Int[Array, "count"]:
    """Return indices of the allowed candidates that together make the criterion smallest."""
    allowed_count = int(np.sum(allowed))
    # A pose that no joints reach is NaN: in a sum it would make every candidate NaN.
    finite = np.isfinite(np.asarray(information)).all(axis=(1, 2), keepdims=True)
    information = to_device(np.where(finite, np.asarray(information), 0.0))
    say(f"choosing {count} of {allowed_count} candidates")
    # Greedy selection is fast but depends on the order; exchange corrects its early choices.
    index = greedy_selection(information, prior_information, criterion, count, allowed)
    say(f"exchanging chosen views for better ones among {allowed_count} candidates")
    return exchange_selection(information, prior_information, criterion, index, allowed)


def require_enough(count: int, allowed: Bool[AnyArray, "candidates"], kind: str) -> None:
    """Raise a ValueError unless `count` candidates, called by their kind, may be taken."""
    most = int(np.sum(allowed))
    if count < 1:
        raise ValueError(f"count: expected at least 1, found {count}")
    if count > most:
        raise ValueError(
            f"{count} {kind} requested, but only {most} of {len(allowed)} candidates may be taken"
        )


def require_metres(poses: SE3, farthest: float, place: str) -> None:
    """Raise a ValueError if a candidate is farther than an arm gets (m), as in millimetres.

    A target that far away is a dot in the picture, so that nothing else would tell. Poses that are
    not finite are passed over.
    """
    distance = np.linalg.norm(host_matrices(poses)[:, :3, 3], axis=1)
    far = np.flatnonzero(distance > farthest)
    if len(far):
        raise ValueError(
            f"views: candidate {far[0]} is {distance[far[0]]:.4g} m from {place}, and no arm gets "
            "that far: millimetres given as metres?"
        )


def order_by_gain(
    information: Float[Array, "views free free"],
    prior_information: Float[Array, "free free"],
    criterion: OptimalityCriterion,
) -> Int[Array, "views"]:
    """Return an order of views in which each is the best addition to those before it."""
    all_views = to_device(np.ones(len(information), dtype=bool))
    return greedy_selection(information, prior_information, criterion, len(information), all_views)


@compiled_optimised
def greedy_selection(
    information: Float[Array, "candidates free free"],
    prior_information: Float[Array, "free free"],
    criterion: OptimalityCriterion,
    count: int,
    allowed: Bool[Array, "candidates"],
) -> Int[Array, "count"]:
    """Return indices of candidates, each the best addition to those before it."""
    start = prior_information + _regularisation(information, prior_information)

    # Information adds up, so F + F_c of every candidate c is one sum, and per step
    #     c* = argmin over available c of criterion(F + F_c),    F <- F + F_c*
    # where F is the `accumulated` information.
    def add(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Int[Array, ""]]:
        accumulated, available = state
        best = jnp.argmin(_criterion_values(criterion, accumulated[None] + information, available))
        return (accumulated + information[best], available.at[best].set(False)), best

    return jax.lax.scan(add, (start, allowed), length=count)[1]


@compiled_optimised
def exchange_selection(
    information: Float[Array, "candidates free free"],
    prior_information: Float[Array, "free free"],
    criterion: OptimalityCriterion,
    chosen: Int[Array, "count"],
    allowed: Bool[Array, "candidates"],
) -> Int[Array, "count"]:
    """Return the selection after replacing views by better candidates, as long as this helps."""
    start = prior_information + _regularisation(information, prior_information)

    def exchange_view(k: Int[Array, ""], chosen: Int[Array, "count"]) -> Int[Array, "count"]:
        # Information without the view that may be replaced:
        #     F_others = F_0 + sum over chosen F_c - F_k
        remaining_information = (
            start + jnp.sum(information[chosen], axis=0) - information[chosen[k]]
        )
        available = allowed.at[chosen].set(False).at[chosen[k]].set(True)
        values = _criterion_values(criterion, remaining_information[None] + information, available)
        best = jnp.argmin(values)
        is_better = values[best] < (1.0 - MIN_RELATIVE_DECREASE) * values[chosen[k]]
        return chosen.at[k].set(jnp.where(is_better, best, chosen[k]))

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        before, _, sweeps = state
        after = jax.lax.fori_loop(0, len(chosen), exchange_view, before)
        return after, jnp.any(after != before), sweeps + 1

    def is_improving(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        return state[1] & (state[2] < MAX_EXCHANGE_SWEEPS)

    return jax.lax.while_loop(is_improving, sweep, (chosen, jnp.array(True), jnp.array(0)))[0]


@compiled_optimised
def cumulative_criterion(
    information: Float[Array, "views free free"],
    prior_information: Float[Array, "free free"],
    criterion: OptimalityCriterion,
) -> Float[Array, "views"]:
    """Return the criterion after one view, two views, and so on; infinite where undetermined."""
    values = jax.lax.map(criterion, prior_information[None] + jnp.cumsum(information, axis=0))
    return jnp.where(jnp.isfinite(values), values, jnp.inf)


def views_needed(
    values: Float[AnyArray, "views"],
    min_relative_decrease: float = 0.05,
    required_value: float | None = None,
) -> int:
    """Return after how many views to stop, at a required value or at a small decrease per view.

    Args:
        values: values of a `cumulative_criterion`.
        min_relative_decrease: smallest relative decrease by one more view for it to be worthwhile.
        required_value: value of the criterion at which to stop even if more views would decrease
            it further.

    Returns:
        A number from 1; the number of all views if neither condition is met earlier.
    """
    # `value` belongs to k views, and values[k], counted from zero, to k + 1 views.
    values = np.asarray(values)
    for k, value in enumerate(values, start=1):
        if required_value is not None and value <= required_value:
            return k
        if (
            k < len(values)
            and np.isfinite(value)
            and values[k] > (1.0 - min_relative_decrease) * value
        ):
            return k
    return len(values)


@dataclass(frozen=True)
class StopRule:
    """The rule by which a plan ends: with so many views, or where another is not worth its time.

    Attributes:
        count: largest number of views.
        goal: value of the criterion at which to stop, in its unit; None for none.
        least_gain: relative decrease by one more view below which to stop.
    """

    count: int
    goal: float | None = None
    least_gain: float = 0.05


@dataclass(frozen=True)
class ViewRequirements:
    """The requirements on a view: how much of the target it shows, and where it may be.

    Attributes:
        border_margin: smallest distance from the picture's border of a point that counts as
            visible, px.
        min_visible_fraction: smallest fraction of the target's points that a view has to show.
        allowed: returns which views may be taken; None for all.
    """

    border_margin: float = 0.0
    min_visible_fraction: float = 1.0
    allowed: Callable[[SE3], Bool[AnyArray, "views"]] | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.border_margin < np.inf:
            raise ValueError(f"border_margin: expected px, at least 0, found {self.border_margin}")
        if not 0.0 <= self.min_visible_fraction <= 1.0:
            raise ValueError(
                f"min_visible_fraction: expected 0 to 1, found {self.min_visible_fraction}"
            )

    def may_be_taken(self, poses: SE3) -> Bool[np.ndarray, "views"]:
        """Return which poses are finite and allowed; a ValueError unless each view has a flag."""
        finite = np.asarray(np.isfinite(np.asarray(poses.wxyz_xyz)).all(axis=1))
        if self.allowed is None:
            return finite
        allowed = np.asarray(self.allowed(poses))
        if allowed.shape != finite.shape:
            raise ValueError(
                f"allowed: expected a flag for each of {len(finite)} views, found an array of "
                f"shape {allowed.shape}"
            )
        return finite & allowed


class RequirementOptions(TypedDict, total=False):
    """The fields of `ViewRequirements` as keyword arguments of `choose_views`."""

    border_margin: float
    min_visible_fraction: float
    allowed: Callable[[SE3], Bool[AnyArray, "views"]] | None


class Worth(NamedTuple):
    """The value of a criterion before and after each view, and how many of them are worth taking.

    Attributes:
        before: with no view; infinite where undetermined.
        values: after one view, two views, and so on.
        needed: number of views after which to stop, from 0.
    """

    before: float
    values: tuple[float, ...]
    needed: int


def worth_of_views(
    criterion: OptimalityCriterion,
    prior_information: Float[Array, "free free"],
    values: Float[Array, "views"],
    stop: StopRule,
) -> Worth:
    """Return up to which view another one is worth its time, from the cumulative criterion."""
    before = float(criterion(prior_information))
    before = before if np.isfinite(before) else float("inf")
    after = tuple(np.asarray(values).tolist())
    # The state before counts too: possibly no view at all is worthwhile.
    needed = views_needed(to_device([before, *after]), stop.least_gain, stop.goal) - 1
    return Worth(before, after, needed)


def _criterion_values(
    criterion: OptimalityCriterion,
    information: Float[Array, "candidates free free"],
    available: Bool[Array, "candidates"],
) -> Float[Array, "candidates"]:
    """Return the criterion with each candidate added; infinite for unavailable candidates."""
    values = jax.vmap(criterion)(information)
    return jnp.where(available & jnp.isfinite(values), values, jnp.inf)


def _regularisation(
    information: Float[Array, "candidates free free"], prior_information: Float[Array, "free free"]
) -> Float[Array, "free free"]:
    """Return a small diagonal matrix in proportion to the information of all candidates."""
    return REGULARISATION_FRACTION * jnp.diag(
        jnp.diagonal(prior_information + jnp.sum(information, axis=0))
    )
