"""Pick one object out of a cell: look, verify, plan, grasp."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..geometry import host_transforms
from ..grasping import PHASES, GraspPlan, GraspScene, Motion, PlannedGrasp, grasps_for
from ..localization import Localization, Localizations
from ..modeling import ObjectModel
from ..robots import Command, Gripper
from ..runtime.array_namespace import to_device
from ..simulation import Cell, CellError
from .looking import DEFAULT_OPTIONS, BadPictureError, Look, LookOptions, Region, look_for

EMPTY_FRACTION = 0.5
"""Distance of the closed fingers, over the object's width, below which they hold nothing."""


class Pick(NamedTuple):
    """An attempt to pick an object.

    Attributes:
        look: pictures, views and found objects; None if the first views are not reached, or one of
            their pictures is unusable.
        target: the chosen object; None if none was accepted or none can be grasped.
        plan: its grasps; for the last object tried if no grasp is safe.
        grasp: the executed grasp.
        width: distance of the closed fingers, m; NaN if nothing was executed.
        outcome: what happened, in words.
        considered: for each accepted object, its best grasp or why it has none; `look.found` has
            the messages on the others.
    """

    look: Look | None
    target: Localization | None
    plan: GraspPlan | None
    grasp: PlannedGrasp | None
    width: float
    outcome: str
    considered: tuple[str, ...] = ()


def pick(
    cell: Cell,
    models: Sequence[ObjectModel],
    gripper: Gripper,
    region: Region,
    scene: GraspScene,
    *,
    motion: Motion | None = None,
    options: LookOptions = DEFAULT_OPTIONS,
    progress: Callable[[str], None] | None = None,
    after: Callable[[str], None] | None = None,
) -> Pick:
    """Look for objects, choose the one with the safest grasp, and execute it.

    An object without a safe grasp does not keep the others from being grasped. Found objects that
    are not chosen are obstacles, even if their verdict is open, unless their model has no faces:
    the outcome says so. Objects that were not found are unknown, and not avoided.

    Args:
        cell: with an empty gripper.
        gripper: on the hand.
        region: where objects are searched.
        scene: the calibrated robot, which also takes the views, and the obstacles.
        motion: as for `grasps_for`.
        options, progress: as for `look_for`.
        after: as for `execute`.

    Raises:
        ValueError: as in `look_for`, for invalid arguments, and as in `grasps_for`.
    """
    say, nothing = progress or (lambda _: None), float("nan")
    try:
        look = look_for(cell, scene, models, region, options=options, progress=progress)
    except (BadPictureError, CellError) as error:
        # No program fault, but for example a lamp that is off, or a place that is out of reach.
        return Pick(None, None, None, None, nothing, f"not found: {error}")
    if not look.found.accepted:
        return Pick(look, None, None, None, nothing, "; ".join(look.found.messages))
    say("planning grasps")
    planned = [_planned(obj, look.found, gripper, scene, motion) for obj in look.found.accepted]
    plans = [(obj, plan) for obj, plan, _ in planned if plan is not None]
    undecided = [
        f"{obj.name} is not grasped: {obj.message.partition(': ')[2]}" for obj in look.found.open
    ]
    considered = (*(clause for *_, clause in planned), *undecided)
    safe = [(obj, plan) for obj, plan in plans if len(plan)]
    if not safe:
        last = plans[-1][1] if plans else None
        reasons = "; ".join(clause for *_, clause in planned)
        return Pick(look, None, last, None, nothing, reasons, considered)
    target, plan = max(safe, key=lambda entry: entry[1].best.success_probability)
    say(plan.summary)
    # The gripper may touch objects that are no obstacles: the outcome says so.
    bare = [obj.name for obj in _obstacles(look.found) if not obj.model.faces]
    note = f"; not avoided, because their models have no faces: {', '.join(bare)}" if bare else ""
    try:
        width, outcome = execute(cell, plan.best, after)
    except CellError as error:
        # It is unknown what the fingers hold then.
        width, outcome = nothing, f"not executed to the end: {error}"
    return Pick(look, target, plan, plan.best, width, outcome + note, considered)


def _planned(
    obj: Localization,
    results: Localizations,
    gripper: Gripper,
    scene: GraspScene,
    motion: Motion | None,
) -> tuple[Localization, GraspPlan | None, str]:
    """Return an accepted object with its plan, and a clause on its grasps or why there is none."""
    # A wireframe without faces has no width for the fingers.
    if not obj.model.faces:
        return obj, None, f"no safe grasp of {obj.name}: its model has no faces"
    # Compared by identity, since two objects may be of one model.
    others = [other for other in _obstacles(results) if other is not obj and other.model.faces]
    plan = grasps_for(obj, gripper, scene.with_objects(others), motion)
    return obj, plan, plan.summary


def _obstacles(results: Localizations) -> tuple[Localization, ...]:
    """Return the objects that may be at their poses: accepted and open ones."""
    return (*results.accepted, *results.open)


def execute(
    cell: Cell, grasp: PlannedGrasp, after: Callable[[str], None] | None = None
) -> tuple[float, str]:
    """Execute a grasp: approach, close, lift, retreat.

    Args:
        cell: with an empty gripper.
        grasp: a safe one.
        after: called with the name of each phase when it is reached, and with "closed".

    Returns:
        The distance of the closed fingers, m, and a sentence that interprets it.

    Raises:
        ValueError: the grasp is refused.
        CellError: the robot does not reach a pose.
    """
    if not grasp.is_safe:
        raise ValueError(f"the grasp is not executed: {'; '.join(grasp.reasons)}")
    done = after or (lambda _: None)
    # Opened far from the object, where nothing is in the way.
    cell.set_gripper(grasp.opening)
    width = grasp.opening
    for k, phase in enumerate(PHASES):
        # Poses only, if the planning did not know the arm.
        joints = None if grasp.joints is None else to_device(grasp.joints[k])
        cell.move(Command(host_transforms(grasp.base_from_tool[k]), joints))
        done(phase)
        if phase == "grasp":
            width = cell.set_gripper(0.0)
            done("closed")
    # The fingers show whether something stopped them; a real robot has no judge.
    if width < EMPTY_FRACTION * grasp.width:
        return width, f"the fingers closed to {1e3 * width:.1f} mm: they hold nothing"
    return width, (
        f"the fingers stand {1e3 * width:.1f} mm apart; the object is {1e3 * grasp.width:.1f} mm "
        "wide there"
    )
