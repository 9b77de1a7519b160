"""Choose the states of a rig's robot that tell most about all of its cameras."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float, Int

from ..dataset import Rig
from ..geometry import host_matrices, host_transforms
from ..robots import MAX_TOOL_COORDINATE, CommandLike, as_command
from ..runtime.array_namespace import to_device
from .candidate_selection import (
    ViewRequirements,
    best_candidates,
    cumulative_criterion,
    order_by_gain,
    require_enough,
    require_metres,
)
from .optimality_criteria import OptimalityCriterion
from .rig_information import RigInformationModel


class ChosenStates(eqx.Module):
    """The chosen states of a rig's robot, best first.

    Attributes:
        states: index of each among the candidates.
        view_ids: names of these states in the rig of the candidates; numbers from 0 for poses.
        base_from_tool: commands of the states `(count)`.
        cumulative_criterion: the criterion after the first state, the first two, and so on.
        unit: unit of the criterion.
    """

    states: Int[np.ndarray, "count"]
    view_ids: tuple[str, ...] = eqx.field(static=True)
    base_from_tool: SE3
    cumulative_criterion: Float[Array, "count"]
    unit: str = eqx.field(static=True)

    @property
    def value(self) -> Float[Array, ""]:
        """The value of the criterion after all states."""
        return self.cumulative_criterion[-1]


def choose_states(
    model: RigInformationModel,
    criterion: OptimalityCriterion,
    count: int,
    candidates: Rig | CommandLike,
    needs: ViewRequirements,
    progress: Callable[[str], None] | None = None,
) -> ChosenStates:
    """Return the states of the robot that make an optimality criterion as small as possible.

    `choose_views` calls it for a rig; its arguments are explained there, and the requirements in
    `ViewRequirements`.
    """
    say = progress or (lambda _: None)
    rig = candidates
    if not isinstance(candidates, Rig):
        command = as_command(candidates)
        require_metres(command.base_from_tool, MAX_TOOL_COORDINATE, "the robot's base")
        say("computing what each camera would see")
        rig = model.planned(candidates, needs.border_margin)
    assert isinstance(rig, Rig)
    admissible = np.zeros(rig.view_count, dtype=bool)
    admissible[rig.usable_views()] = True
    if not isinstance(candidates, Rig):
        admissible &= _largest_visible_fraction(rig) >= needs.min_visible_fraction - 1e-9
    admissible &= needs.may_be_taken(rig.base_from_tool)
    require_enough(count, admissible, "states")
    say("computing what each state would tell")
    information, prior = model.information(rig), model.prior_information
    index = best_candidates(information, prior, criterion, count, to_device(admissible), say)
    say("ordering them, best first")
    chosen, of_states = np.asarray(index), np.asarray(information)
    order = order_by_gain(to_device(of_states[chosen]), prior, criterion)
    chosen = chosen[np.asarray(order)]
    return ChosenStates(
        chosen,
        tuple(rig.view_ids[state] for state in chosen),
        host_transforms(host_matrices(rig.base_from_tool)[chosen]),
        cumulative_criterion(to_device(of_states[chosen]), prior, criterion),
        criterion.unit,
    )


def _largest_visible_fraction(rig: Rig) -> Float[np.ndarray, "states"]:
    """Return the largest fraction of its target that any camera sees, for each state."""
    fraction = np.zeros(rig.view_count)
    for name, data in rig.cameras.items():
        states = rig.state_index[name]
        fraction[states] = np.maximum(fraction[states], np.asarray(data.visible).mean(axis=1))
    return fraction
