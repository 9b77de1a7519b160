"""Choosing views: greedily, by exchange, and by the goal's gradient through the whole model."""

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
"""Drawn where none are given."""

STEPS = 150
"""Of BFGS, at most."""

CROSSING = 10.0
"""Pixels by which a point beyond its margin costs as much as a factor of e in the goal."""

BACK_OFF = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Shares of its way that a refined view may keep until it is allowed again."""

Allowed = Callable[[SE3], Bool[Array, "views"]]
"""Which views `camera_from_world` `(views)` may be taken."""


class ChosenViews(eqx.Module):
    """Views, best first.

    Attributes:
        camera_from_world: `(count)`; `viewpoint_commands` says what to tell the robot.
        curve: the goal after the first, after the first two, and so on.
        unit: of the goal.
    """

    camera_from_world: SE3
    curve: Float[Array, "count"]
    unit: str = eqx.field(static=True)

    @property
    def value(self) -> Float[Array, ""]:
        """The goal after all of them."""
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
    """The views to take next, so that the goal becomes as small as it can.

    Args:
        survey: what is known, and what views will tell.
        goal: what they are to be good for.
        count: how many to choose.
        views: candidates `camera_from_world`, or the range that they are drawn from and, unless
            `refine` is False, moved in by gradient.
        margin: between the picture's border and a point that counts as seen, px.
        share: of the target's points that a view has to show.
        allowed: says which views may be taken, such as those that an arm reaches.
        seed: of the candidates that are drawn.
        refine: see `views`.
        progress: told what is being done.

    Raises:
        ValueError: there are not that many candidates that may be taken.
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
    index = greedy(information, survey.prior, goal, count, good)
    index = exchanged(information, survey.prior, goal, index, good)
    poses, told = SE3(candidates.wxyz_xyz[index]), information[index]
    if refine and isinstance(views, ViewRange) and numbers is not None:
        say("moving them by the gradient")
        moved = refined(survey, goal, views, numbers[index], margin, share, fine)
        told_there = survey.information(moved)
        if bool(_total(goal, told_there, survey) < _total(goal, told, survey)):
            poses, told = moved, told_there
    order = greedy(told, survey.prior, goal, count, jnp.ones(count, dtype=bool))
    return ChosenViews(
        SE3(poses.wxyz_xyz[order]), curve(told[order], survey.prior, goal), goal.unit
    )


def shown(survey: Survey, camera_from_world: SE3, margin: float) -> Float[Array, "views"]:
    """Share of the target's points that are in the picture, a margin from its border."""
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
    """Views moved by BFGS to where the goal is least; where they are no longer fine, moved back.

    What the range limits cannot be left; points that would leave the picture cost as much as makes
    it not worth it.
    """
    begin = views.without_limits(numbers)
    found = _descended(begin, survey, goal, views, margin, share)
    keep = jnp.zeros(len(numbers))
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
    needed = int(np.ceil(share * len(survey.points) - 1e-9))

    def cost(free: Float[Array, "count 6"], _: Any) -> Float[Array, ""]:
        poses = views.poses(views.within_limits(free))
        inner = survey.border_distance(poses) - margin
        # Of the points that have to be seen, those that are farthest inside.
        inner = jax.lax.top_k(jnp.where(jnp.isfinite(inner), inner, -1e3), needed)[0]
        beyond = jnp.maximum(0.0, 1.0 - inner) / CROSSING
        return jnp.log(_total(goal, survey.information(poses), survey)) + jnp.sum(beyond**2)

    solver = optx.BFGS(rtol=1e-5, atol=1e-5)
    return optx.minimise(cost, solver, begin, max_steps=STEPS, throw=False).value


def _total(goal: Goal, told: Float[Array, "views free free"], survey: Survey) -> Float[Array, ""]:
    return goal(survey.prior + jnp.sum(told, axis=0))
