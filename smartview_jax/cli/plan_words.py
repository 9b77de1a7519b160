"""Describe the gain of a view plan in words and as entries of a JSON document."""

import math
from typing import Any

import smartview_jax as sv

from .documents import print_document
from .terminal import print_lines

_NUMBERS = "no one two three four five six seven eight nine ten eleven twelve".split()


def plan_words(
    plan: "sv.viewpoints.ViewPlan", least_gain: float, goal_mm: float | None, first: bool
) -> list[str]:
    """Return sentences about the gain of the planned views and why the plan stops.

    Args:
        least_gain: smallest relative decrease of the error for which a view is added.
        goal_mm: error at which the plan stops, mm; None for none.
        first: whether there are no views yet.
    """
    count, quantity = len(plan.camera_from_world), _quantity(plan)
    before, after = _size(plan.before, plan), f"{_size(plan.after, plan)} (standard deviation)"
    reason = _stopping_reason(plan, least_gain, goal_mm)
    if count == 0:
        return [f"no more views are needed: {quantity} is known to {before}{reason}"]
    noun, verb = ("view", "brings") if count == 1 else ("views", "bring")
    # First views have no error to improve on.
    if first or not math.isfinite(plan.before):
        return [f"{_number(count)} {noun} will determine {quantity} to {after}"]
    # The unit once is enough: "from 0.8 to 0.5 mm".
    error = f"from {before.split()[0]} to {after}"
    return [f"{_number(count)} more {noun} {verb} the error of {quantity} {error}{reason}"]


def plan_entries(plan: "sv.viewpoints.ViewPlan") -> dict[str, Any]:
    """Return the errors before and after each view, in mm (px where the hand-eye is held)."""
    unit, factor = ("mm", 1e3) if plan.unit == "m" else (plan.unit, 1.0)
    return {
        "views": len(plan.camera_from_world),
        f"std_before_{unit}": factor * plan.before,
        f"std_after_{unit}": factor * plan.after,
        # For all views considered, also after the stop.
        f"std_after_each_{unit}": [factor * value for value in plan.values],
        "point_distance_mm": 1e3 * plan.distance,
    }


def give_no_commands(entries: dict[str, Any], json: bool) -> None:
    """Print that there is no view to take, and the words that say why; no commands are written."""
    if json:
        print_document("plan", {"commands": [], **entries, "file": None})
    else:
        print_lines(*entries["words"])


def _quantity(plan: "sv.viewpoints.ViewPlan") -> str:
    """Return the name of the quantity whose error the plan minimises."""
    if plan.unit == "m":
        camera = "each camera" if len(plan.cameras) > 1 else "the camera"
        return f"a point {plan.distance:.2g} m in front of {camera} (in the tool frame)"
    return "predicted pixels"


def _stopping_reason(
    plan: "sv.viewpoints.ViewPlan", least_gain: float, goal_mm: float | None
) -> str:
    """Return why the plan stops, as the end of a sentence."""
    count = len(plan.camera_from_world)
    # A goal in mm does not apply to pixels.
    if goal_mm is not None and plan.unit == "m" and 1e3 * plan.after <= goal_mm:
        return f": the goal of {goal_mm:g} mm is reached"
    missed = "" if goal_mm is None else f"; the goal of {goal_mm:g} mm is not reached"
    # More views were considered than are worth taking.
    if count < len(plan.values):
        return f"; one more view would gain less than {least_gain:.0%}{missed}"
    return f"; more views would still help: plan again after these{missed}"


def _size(value: float, plan: "sv.viewpoints.ViewPlan") -> str:
    """Return the criterion's value as text, in mm where it is a length."""
    factor, unit = (1e3, "mm") if plan.unit == "m" else (1.0, plan.unit)
    return f"{factor * value:.2g} {unit}"


def _number(count: int) -> str:
    """Return a small number as a word, a larger one in digits."""
    return _NUMBERS[count] if count < len(_NUMBERS) else str(count)


def new_names(taken: tuple[str, ...], count: int) -> tuple[str, ...]:
    """Return names that no view of the data set has: v16, v17, ..."""
    numbers = range(1 + len(taken), 1 + 2 * len(taken) + count)
    # A name twice in poses.csv would be ambiguous.
    return tuple(f"v{k}" for k in numbers if f"v{k}" not in taken)[:count]
