"""Choose the best next views: greedy selection, exchange, and refinement by gradient."""

import dataclasses
from collections.abc import Callable
from typing import Any, Unpack, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..dataset import Rig
from ..robots import MAX_TOOL_COORDINATE, CommandLike
from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.compilation import compiled_optimised, one_program
from .candidate_selection import (
    RequirementOptions,
    ViewRequirements,
    best_candidates,
    cumulative_criterion,
    order_by_gain,
    require_enough,
    require_metres,
)
from .information_model import InformationModel
from .optimality_criteria import OptimalityCriterion
from .rig_information import RigInformationModel
from .rig_planning import ChosenStates, choose_states
from .view_range import ViewRange

DEFAULT_CANDIDATE_COUNT = 1000
"""Number of random candidates, if no candidates are given."""

MAX_BFGS_STEPS = 150
"""Largest number of BFGS iterations."""

BORDER_PENALTY_SCALE = 10.0
"""Distance beyond the margin, px, at which a point costs as much as a factor e of the criterion."""

BACKTRACKING_FRACTIONS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Fractions of its displacement that a refined view may keep so as to be admissible."""


class ChosenViews(eqx.Module):
    """The chosen views, best first.

    Attributes:
        camera_from_world: poses `(count)`; `viewpoint_commands` converts them to robot commands.
        cumulative_criterion: the criterion after the first view, the first two, and so on.
        unit: unit of the criterion.
    """

    camera_from_world: SE3
    cumulative_criterion: Float[Array, "count"]
    unit: str = eqx.field(static=True)

    @property
    def value(self) -> Float[Array, ""]:
        """The value of the criterion after all views."""
        return self.cumulative_criterion[-1]


@overload
def choose_views(
    information_model: InformationModel,
    criterion: OptimalityCriterion,
    count: int,
    views: SE3 | ViewRange,
    *,
    seed: int = 0,
    refine: bool = True,
    progress: Callable[[str], None] | None = None,
    **required: Unpack[RequirementOptions],
) -> ChosenViews: ...


@overload
def choose_views(
    information_model: RigInformationModel,
    criterion: OptimalityCriterion,
    count: int,
    views: Rig | CommandLike,
    *,
    progress: Callable[[str], None] | None = None,
    **required: Unpack[RequirementOptions],
) -> ChosenStates: ...


def choose_views(
    information_model: InformationModel | RigInformationModel,
    criterion: OptimalityCriterion,
    count: int,
    views: SE3 | ViewRange | Rig | CommandLike,
    *,
    seed: int = 0,
    refine: bool = True,
    progress: Callable[[str], None] | None = None,
    **required: Unpack[RequirementOptions],
) -> ChosenViews | ChosenStates:
    """Return the next views that make an optimality criterion as small as possible.

    Of a rig, states of its robot are chosen, each with the pictures of all cameras.

    Args:
        information_model: prior information, and the model of the information of views.
        criterion: the criterion that the views minimise.
        views: candidates `camera_from_world`, or the range in which candidates are sampled at
            random and then refined by gradient, unless `refine` is False. Of a rig, commands
            `base_from_tool` of states to take, or a `Rig` of states to keep.
        seed: seed of the random candidates.
        refine: see `views`.
        progress: called with a text for each stage.
        border_margin: smallest distance from the picture's border of a point that counts as
            visible, px; 0 by default.
        min_visible_fraction: smallest fraction of the target's points that a view has to show, by
            default all; in a state to take, at least one camera has to see so many.
        allowed: returns which views may be taken, such as those that an arm reaches. Of a rig, it
            is called with `base_from_tool`.

    Raises:
        TypeError: views of a wrong type.
        ValueError: fewer than `count` candidates may be taken (never one that is not finite), a
            candidate farther than arms get, or a requirement out of range.

    For example:

        >>> model = sv.viewpoints.InformationModel.from_calibration(truth, points, noise)
        >>> candidates = truth.camera_from_world(data.base_from_tool)
        >>> chosen = sv.choose_views(model, sv.viewpoints.d_optimal(), 4, candidates)
        >>> chosen.camera_from_world.get_batch_axes()
        (4,)

    Of a rig, here with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> truths = {"left": truth, "right": truth}
        >>> model = sv.viewpoints.RigInformationModel.from_calibrations(truths, rig, noise)
        >>> chosen = sv.choose_views(model, sv.viewpoints.a_optimal(model, 0.2), 4, rig)
        >>> chosen.view_ids
        ('0', '1', '5', '2')
    """
    needs = ViewRequirements(**required)
    if isinstance(information_model, RigInformationModel):
        if isinstance(views, ViewRange):
            raise TypeError("choose_views: of a rig, expected states of the robot or a Rig")
        return choose_states(information_model, criterion, count, views, needs, progress)
    if not isinstance(views, SE3 | ViewRange):
        raise TypeError("choose_views: expected poses camera_from_world or a ViewRange")
    say = progress or (lambda _: None)

    def is_admissible(poses: SE3) -> Bool[Array, "views"]:
        visible = visible_fraction(information_model, poses, needs.border_margin)
        enough_visible = visible >= needs.min_visible_fraction - 1e-9
        return to_device(enough_visible & needs.may_be_taken(poses))

    if isinstance(views, ViewRange):
        coordinates = views.sample(np.random.default_rng(seed), DEFAULT_CANDIDATE_COUNT)
        candidates = views.poses(coordinates)
    else:
        coordinates, candidates = None, views
    require_metres(candidates, _farthest(information_model), "the target")
    number = candidates.wxyz_xyz.shape[0]
    say(f"checking {number} candidate views")
    admissible = is_admissible(candidates)
    require_enough(count, admissible, "views")
    say("computing what each candidate would tell")
    information = information_model.information(candidates)
    prior = information_model.prior_information
    index = best_candidates(information, prior, criterion, count, admissible, say)
    chosen = _rows((candidates, information), index)
    if refine and isinstance(views, ViewRange) and coordinates is not None:
        say("moving them by the gradient")
        admissible_needs = dataclasses.replace(needs, allowed=is_admissible)
        begin = _rows(coordinates, index)
        refined = refine_views(information_model, criterion, views, begin, admissible_needs)
        # Moving views back to where they are admissible may undo the improvement.
        chosen = min(
            (chosen, (refined, information_model.information(refined))),
            key=lambda pair: float(_total_criterion(criterion, pair[1], information_model)),
        )
    say("ordering them, best first")
    # The first few are then a good choice too.
    poses, information = _rows(chosen, order_by_gain(chosen[1], prior, criterion))
    return ChosenViews(poses, cumulative_criterion(information, prior, criterion), criterion.unit)


def _farthest(information_model: InformationModel) -> float:
    """Return the largest distance from camera to target that an arm allows, m."""
    transforms = information_model.calibration.transforms.values()
    lengths = [np.linalg.norm(np.asarray(part.wxyz_xyz)[4:]) for part in transforms]
    return MAX_TOOL_COORDINATE + float(np.sum(lengths))


@one_program
def _rows(arrays: Any, index: Int[Array, "count"]) -> Any:
    """Return the rows of arrays, or of transforms, at the given indices."""
    return jax.tree.map(lambda array: array[index], arrays)


def visible_fraction(
    information_model: InformationModel, camera_from_world: SE3, border_margin: float
) -> Float[np.ndarray, "views"]:
    """Return the fraction of the target's points visible at least a margin inside the border."""
    inside = np.asarray(information_model.border_distance(camera_from_world)) >= border_margin
    return inside.mean(axis=-1)


def refine_views(
    information_model: InformationModel,
    criterion: OptimalityCriterion,
    views: ViewRange,
    coordinates: Float[Array, "count 6"],
    needs: ViewRequirements,
) -> SE3:
    """Return views refined by BFGS towards the smallest criterion, all of them allowed.

    The limits of the range always hold. Points that leave the picture are penalised. A refined view
    that is not allowed is moved back towards its initial pose until it is.
    """
    initial = views.to_unbounded(coordinates)
    minimiser = _minimise_bfgs(
        initial,
        information_model,
        criterion,
        views,
        needs.border_margin,
        needs.min_visible_fraction,
    )
    assert needs.allowed is not None
    accepted_fraction = np.zeros(len(coordinates))
    # From small to large fractions: each view keeps its last admissible one.
    for fraction in BACKTRACKING_FRACTIONS[::-1]:
        poses = _poses_between(views, initial, minimiser, np.full(len(coordinates), fraction))
        accepted_fraction[np.asarray(needs.allowed(poses))] = fraction
    return _poses_between(views, initial, minimiser, accepted_fraction)


@compiled_optimised
def _poses_between(
    views: ViewRange,
    initial: Float[Array, "count 6"],
    minimiser: Float[Array, "count 6"],
    fraction: Float[AnyArray, "count"],
) -> SE3:
    """Return the poses at fractions of the way between unbounded coordinates."""
    unbounded = initial + jnp.asarray(fraction)[:, None] * (minimiser - initial)
    return views.poses(views.from_unbounded(unbounded))


@compiled_optimised
def _minimise_bfgs(
    initial: Float[Array, "count 6"],
    information_model: InformationModel,
    criterion: OptimalityCriterion,
    views: ViewRange,
    border_margin: float,
    min_visible_fraction: float,
) -> Float[Array, "count 6"]:
    """Return the unbounded coordinates of views at which BFGS ends."""
    required_points = int(np.ceil(min_visible_fraction * len(information_model.points) - 1e-9))

    def cost(unbounded: Float[Array, "count 6"], _: Any) -> Float[Array, ""]:
        poses = views.poses(views.from_unbounded(unbounded))
        inner_distance = information_model.border_distance(poses) - border_margin
        # Only the required number of points counts, the ones farthest inside: the others may leave
        # the picture. A point that cannot be projected is at minus infinity, which has no finite
        # square.
        inner_distance = jax.lax.top_k(
            jnp.where(jnp.isfinite(inner_distance), inner_distance, -1e3), required_points
        )[0]
        violation = jnp.maximum(0.0, 1.0 - inner_distance) / BORDER_PENALTY_SCALE
        # cost = log criterion + sum of ((1 - inner_distance)+ / BORDER_PENALTY_SCALE)^2
        # The logarithm makes the minimiser independent of the criterion's unit. The penalty begins
        # one pixel inside the margin.
        return jnp.log(
            _total_criterion(criterion, information_model.information(poses), information_model)
        ) + jnp.sum(violation**2)

    solver = optx.BFGS(rtol=1e-5, atol=1e-5)
    return optx.minimise(cost, solver, initial, max_steps=MAX_BFGS_STEPS, throw=False).value


@compiled_optimised
def _total_criterion(
    criterion: OptimalityCriterion,
    information: Float[Array, "views free free"],
    information_model: InformationModel,
) -> Float[Array, ""]:
    """Return the criterion for the information of the prior and of all views."""
    return criterion(information_model.prior_information + jnp.sum(information, axis=0))
