"""Say in words, and as entries of a JSON document, what the views of a plan bring."""

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..viewpoints import ViewPlan

_NUMBERS = "no one two three four five six seven eight nine ten eleven twelve".split()


def plan_words(
    plan: "ViewPlan", least_gain: float, goal_mm: float | None, first: bool
) -> list[str]:
    """Return what the views bring, and why to stop there, a sentence each.

    Args:
        plan: the plan.
        least_gain: relative decrease by one more view below which the plan stops.
        goal_mm: error at which it stops, mm; None for none.
        first: whether there are no views yet.
    """
    count, what = len(plan.camera_from_world), _what(plan)
    before, after = _size(plan.before, plan), f"{_size(plan.after, plan)} (standard deviation)"
    why = _why(plan, least_gain, goal_mm)
    if count == 0:
        return [f"no more views are needed: {what} is known to {before}{why}"]
    noun, verb = ("view", "brings") if count == 1 else ("views", "bring")
    # From nothing there is no "from".
    if first or not math.isfinite(plan.before):
        return [f"{_number(count)} {noun} will place {what} to {after}"]
    # The unit once is enough: "from 0.8 to 0.5 mm".
    return [f"{_number(count)} more {noun} {verb} {what} from {before.split()[0]} to {after}{why}"]


def plan_entries(plan: "ViewPlan") -> dict[str, Any]:
    """Return the errors before and after each view, in mm (px where the hand-eye is held)."""
    unit, factor = ("mm", 1e3) if plan.unit == "m" else (plan.unit, 1.0)
    return {
        "views": len(plan.camera_from_world),
        f"std_before_{unit}": factor * plan.before,
        f"std_after_{unit}": factor * plan.after,
        # Of all views that were considered, also of those after the stop.
        f"std_after_each_{unit}": [factor * value for value in plan.values],
        "point_distance_mm": 1e3 * plan.distance,
    }


def _what(plan: "ViewPlan") -> str:
    """Return what the criterion is about."""
    if plan.unit == "m":
        return f"a point {plan.distance:.2g} m before the camera, seen from the tool,"
    return "predicted pixels"


def _why(plan: "ViewPlan", least_gain: float, goal_mm: float | None) -> str:
    """Return why the plan stops where it does."""
    count = len(plan.camera_from_world)
    # A goal in mm says nothing of pixels.
    if goal_mm is not None and plan.unit == "m" and 1e3 * plan.after <= goal_mm:
        return f": the goal of {goal_mm:g} mm is reached"
    missed = "" if goal_mm is None else f"; the goal of {goal_mm:g} mm is not reached"
    # More views were considered than are worth taking.
    if count < len(plan.values):
        return f"; one more would gain less than {least_gain:.0%}: stop there{missed}"
    return f"; more would still gain: plan again after them{missed}"


def _size(value: float, plan: "ViewPlan") -> str:
    """Return the criterion's value as text, in mm where it is a length."""
    factor, unit = (1e3, "mm") if plan.unit == "m" else (1.0, plan.unit)
    return f"{factor * value:.2g} {unit}"


def _number(count: int) -> str:
    """Return a number as a word, as far as words are shorter to read."""
    return _NUMBERS[count] if count < len(_NUMBERS) else str(count)
