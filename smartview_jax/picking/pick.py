"""Pick one object out of a cell: look, verify, plan, grasp."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..grasping import GraspPlan, GraspScene, Motion, PlannedGrasp, grasps_for
from ..localization import Localization, Localizations
from ..modeling import ObjectModel
from ..robots import Gripper
from ..simulation import Cell, CellError
from .execution import execute
from .looking import STANDARD_VIEWS, BadPictureError, FirstViews, Look, Region, look_for


class Pick(NamedTuple):
    """An attempt to pick an object.

    Attributes:
        look: pictures, views and what was found; None where one of the first pictures shows
            nothing.
        target: the object that was chosen; None if none was accepted or none can be grasped.
        plan: its grasps; of the last object tried where no grasp is safe.
        grasp: the one that was executed.
        width: distance of the closed fingers, m; NaN where nothing was executed.
        outcome: what happened, in words.
    """

    look: Look | None
    target: Localization | None
    plan: GraspPlan | None
    grasp: PlannedGrasp | None
    width: float
    outcome: str


def pick(
    cell: Cell,
    models: Sequence[ObjectModel],
    gripper: Gripper,
    region: Region,
    scene: GraspScene,
    *,
    motion: Motion | None = None,
    first: FirstViews = STANDARD_VIEWS,
    verify: bool = True,
    progress: Callable[[str], None] | None = None,
    after: Callable[[str], None] | None = None,
) -> Pick:
    """Look for objects, choose the one with the safest grasp, and execute it.

    What was found but not chosen is an obstacle, even where its verdict is open, unless its model
    has no faces: the outcome says so. What was not found is not known, and not avoided.

    Args:
        cell: with an empty gripper.
        models: of the objects that may be there.
        gripper: on the hand.
        region: where objects are looked for.
        scene: the calibrated robot, with which the cell looks too, and what stands around.
        motion: as for `grasps_for`.
        first, verify, progress: as for `look_for`.
        after: as for `execute`.

    Raises:
        CellError: the robot reaches fewer than two of the first views.
        ValueError: as `look_for`, of what was given, and as `grasps_for`.
    """
    say, nothing = progress or (lambda _: None), float("nan")
    try:
        look = look_for(
            cell, scene.calibration, models, region, arm=scene.arm, estimate=scene.estimate,
            occluders=scene.triangles, first=first, verify=verify, progress=progress,
        )  # fmt: skip
    except BadPictureError as error:
        # No fault of the program: a lamp that is off, a cover on the lens.
        return Pick(None, None, None, None, nothing, f"not found: {error}")
    # Nothing is grasped that the verdict did not accept.
    if not look.found.accepted:
        return Pick(look, None, None, None, nothing, "; ".join(look.found.messages))
    say("planning grasps")
    target, plan, reasons = _safest(look.found, gripper, scene, motion)
    if target is None or plan is None:
        return Pick(look, None, plan, None, nothing, "; ".join(reasons))
    say(plan.summary)
    # The gripper may touch what is no obstacle: whoever reads the outcome should know.
    bare = [one.name for one in _obstacles(look.found) if not one.model.faces]
    note = f"; not avoided, because their models have no faces: {', '.join(bare)}" if bare else ""
    try:
        width, outcome = execute(cell, plan.best, after)
    except CellError as error:
        # What the fingers hold then is not known.
        width, outcome = nothing, f"not executed to the end: {error}"
    return Pick(look, target, plan, plan.best, width, outcome + note)


def _safest(
    found: Localizations, gripper: Gripper, scene: GraspScene, motion: Motion | None
) -> tuple[Localization | None, GraspPlan | None, list[str]]:
    """Return the object whose best grasp is the most probable of all, with its plan.

    Where no grasp is safe there is no object, the plan is the last one, and the sentences say why.
    """
    best: tuple[Localization, GraspPlan] | None = None
    plan, reasons = None, []
    for one in found.accepted:
        # A wireframe has no width that fingers could be opened for.
        if not one.model.faces:
            reasons.append(f"no safe grasp of {one.name}: its model has no faces")
            continue
        # Objects are told apart by identity: two may be of one model.
        others = [other for other in _obstacles(found) if other is not one and other.model.faces]
        plan = grasps_for(one, gripper, scene.with_objects(others), motion)
        # Each object that cannot be grasped has its own reason.
        if not len(plan):
            reasons.append(plan.summary)
        elif best is None or _chance(plan) > _chance(best[1]):
            best = one, plan
    return (None, plan, reasons) if best is None else (*best, reasons)


def _obstacles(found: Localizations) -> tuple[Localization, ...]:
    """Return the objects that may be where they were found, the open ones too."""
    return (*found.accepted, *found.open)


def _chance(plan: GraspPlan) -> float:
    """Return the probability of success of the best grasp."""
    return plan.best.success_probability
