"""Choose the best next views: greedy selection, exchange, and refinement by the goal's gradient."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..compilation import optimised
from .goals import Goal
from .selection import curve, exchanged, greedy
from .survey import Survey
from .view_range import ViewRange

CANDIDATES = 1000
"""Number of random candidates, if no candidates are given."""

STEPS = 150
"""Largest number of BFGS steps."""

CROSSING = 10.0
"""Distance, px, beyond the margin at which a point costs as much as a factor of e in the goal."""

BACK_OFF = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Fractions of its displacement that a refined view may keep until it is allowed again."""

Allowed = Callable[[SE3], Bool[Array, "views"]]
"""A function that returns which views `camera_from_world` `(views)` may be taken."""


class ChosenViews(eqx.Module):
    """The chosen views, best first.

    Attributes:
        camera_from_world: poses `(count)`; `viewpoint_commands` converts them to robot commands.
        curve: value of the goal after the first view, the first two, and so on.
        unit: unit of the goal.
    """

    camera_from_world: SE3
    curve: Float[Array, "count"]
    unit: str = eqx.field(static=True)

    @property
    def value(self) -> Float[Array, ""]:
        """The value of the goal after all views."""
        return self.curve[-1]


def choose_views(
    survey: Survey,
    goal: Goal,
    count: int,
    views: SE3 | ViewRange,
    margin: float = 0.0,
    share: float = 1.0,
    allowed: Allowed | None = None,
    seed: int = 0,
    refine: bool = True,
    progress: Callable[[str], None] | None = None,
) -> ChosenViews:
    """Return the next views that make the goal as small as possible.

    Args:
        survey: prior information, and the model of the information of views.
        goal: the criterion that the views minimise.
        count: number of views to choose.
        views: candidates `camera_from_world`, or the range from which candidates are drawn at
            random and in which they are refined by gradient, unless `refine` is False.
        margin: smallest distance from the picture's border of a point that counts as visible, px.
        share: smallest fraction of the target's points that a view has to show.
        allowed: returns which views may be taken, such as those that an arm reaches.
        seed: seed of the random candidates.
        refine: see `views`.
        progress: called with a text for each stage.

    Raises:
        ValueError: fewer than `count` candidates may be taken.
    """
    say = progress or (lambda _: None)

    def fine(poses: SE3) -> Bool[Array, "views"]:
        seen = shown(survey, poses, margin) >= share - 1e-9
        return seen if allowed is None else seen & allowed(poses)

    if isinstance(views, ViewRange):
        numbers = views.drawn(np.random.default_rng(seed), CANDIDATES)
        candidates = views.poses(numbers)
    else:
        numbers, candidates = None, views
    good = fine(candidates)
    if int(jnp.sum(good)) < count or count < 1:
        raise ValueError(
            f"{count} views asked for; of {len(good)} candidates {int(jnp.sum(good))} may be taken"
        )
    say(f"choosing {count} of {int(jnp.sum(good))} candidates")
    information = survey.information(candidates)
    # Greedy selection is fast but depends on the order; exchange repairs its early choices. Only
    # then does the gradient move views between the candidates.
    index = greedy(information, survey.prior, goal, count, good)
    index = exchanged(information, survey.prior, goal, index, good)
    poses, told = SE3(candidates.wxyz_xyz[index]), information[index]
    if refine and isinstance(views, ViewRange) and numbers is not None:
        say("moving them by the gradient")
        moved = refined(survey, goal, views, numbers[index], margin, share, fine)
        told_there = survey.information(moved)
        # Backing off to allowed views can undo the gain, so the refined views are kept only if they
        # are better in fact.
        if bool(_total(goal, told_there, survey) < _total(goal, told, survey)):
            poses, told = moved, told_there
    # The chosen views are sorted by how much each adds, so that a prefix of them is a good choice
    # too.
    order = greedy(told, survey.prior, goal, count, jnp.ones(count, dtype=bool))
    return ChosenViews(
        SE3(poses.wxyz_xyz[order]), curve(told[order], survey.prior, goal), goal.unit
    )


def shown(survey: Survey, camera_from_world: SE3, margin: float) -> Float[Array, "views"]:
    """Return the fraction of the target's points that are visible, a margin inside the border."""
    inside = survey.border_distance(camera_from_world) >= margin
    return jnp.mean(inside.astype(float), axis=-1)


def refined(
    survey: Survey,
    goal: Goal,
    views: ViewRange,
    numbers: Float[Array, "count 6"],
    margin: float,
    share: float,
    fine: Allowed,
) -> SE3:
    """Return views refined by BFGS towards the smallest goal that is still allowed.

    A refined view that is not allowed goes back towards its start until it is.

    The limits of the range always hold. Points that leave the picture are penalised.
    """
    begin = views.without_limits(numbers)
    found = _descended(begin, survey, goal, views, margin, share)
    keep = jnp.zeros(len(numbers))
    # From small to large fractions: the last one that is allowed remains.
    for part in BACK_OFF[::-1]:
        there = views.poses(views.within_limits(begin + part * (found - begin)))
        keep = jnp.where(fine(there), part, keep)
    return views.poses(views.within_limits(begin + keep[:, None] * (found - begin)))


@optimised
def _descended(
    begin: Float[Array, "count 6"],
    survey: Survey,
    goal: Goal,
    views: ViewRange,
    margin: float,
    share: float,
) -> Float[Array, "count 6"]:
    """Return the unbounded coordinates of views at which BFGS ends."""
    needed = int(np.ceil(share * len(survey.points) - 1e-9))

    def cost(free: Float[Array, "count 6"], _: Any) -> Float[Array, ""]:
        poses = views.poses(views.within_limits(free))
        inner = survey.border_distance(poses) - margin
        # Only the required number of points counts, those farthest inside: the others may leave.
        inner = jax.lax.top_k(jnp.where(jnp.isfinite(inner), inner, -1e3), needed)[0]
        beyond = jnp.maximum(0.0, 1.0 - inner) / CROSSING
        # cost = log goal + sum of ((1 - distance)+ / CROSSING)^2
        # The logarithm makes the cost independent of the goal's unit. The penalty begins one pixel
        # inside the margin.
        return jnp.log(_total(goal, survey.information(poses), survey)) + jnp.sum(beyond**2)

    solver = optx.BFGS(rtol=1e-5, atol=1e-5)
    return optx.minimise(cost, solver, begin, max_steps=STEPS, throw=False).value


def _total(goal: Goal, told: Float[Array, "views free free"], survey: Survey) -> Float[Array, ""]:
    """Return the goal for the prior information plus that of all views."""
    return goal(survey.prior + jnp.sum(told, axis=0))
