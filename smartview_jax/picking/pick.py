"""Pick one object out of a cell: look, verify, plan, grasp."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..calibration import Calibration
from ..evaluation import CalibrationEstimate
from ..grasping import GraspPlan, GraspScene, Motion, NoSafeGraspError, PlannedGrasp, grasps_for
from ..localization import Localization
from ..modeling import ObjectModel
from ..robots import Gripper, SerialArm
from ..simulation import Cell, CellError
from .execution import execute
from .looking import Look, Region, look_for


class Pick(NamedTuple):
    """An attempt to pick an object.

    Attributes:
        look: pictures, views and what was found.
        target: the object that was chosen; None if none was accepted or none can be grasped.
        plan: its grasps; of the last object tried where no grasp is safe.
        grasp: the one that was executed.
        width: distance of the closed fingers, m; NaN where nothing was executed.
        outcome: what happened, in words.
    """

    look: Look
    target: Localization | None
    plan: GraspPlan | None
    grasp: PlannedGrasp | None
    width: float
    outcome: str


def pick(
    cell: Cell,
    calibration: Calibration,
    models: Sequence[ObjectModel],
    gripper: Gripper,
    region: Region,
    scene: GraspScene,
    *,
    arm: SerialArm | None = None,
    estimate: CalibrationEstimate | None = None,
    motion: Motion | None = None,
    verify: bool = True,
    progress: Callable[[str], None] | None = None,
    after: Callable[[str], None] | None = None,
) -> Pick:
    """Look for objects, choose the one with the safest grasp, and execute it.

    What was found but not chosen is an obstacle; what was not found is not known, and not avoided.

    Args:
        cell: with an empty gripper.
        calibration: as for `look_for`.
        models: of the objects that may be there.
        gripper: on the hand.
        region: where objects are looked for.
        scene: the robot and what stands around.
        arm, estimate, verify, progress: as for `look_for`.
        motion: as for `grasps_for`.
        after: as for `execute`.

    Raises:
        CellError: the robot does not get to the first views.
    """
    say = progress or (lambda _: None)
    look = look_for(
        cell, calibration, models, region,
        arm=arm, estimate=estimate, known=scene.triangles, verify=verify, progress=progress,
    )  # fmt: skip
    # Nothing is grasped that the verdict did not accept.
    if not look.found.accepted:
        reasons = "; ".join(look.found.messages) or "nothing was found"
        return Pick(look, None, None, None, float("nan"), f"not found: {reasons}")
    say("planning grasps")
    best: tuple[Localization, GraspPlan] | None = None
    plan: GraspPlan | None = None
    for one in look.found.accepted:
        # Objects are told apart by identity: two may be of one model.
        others = [other for other in look.found.accepted if other is not one]
        try:
            plan = grasps_for(one, gripper, scene.with_objects(others), motion)
        except NoSafeGraspError:
            continue
        if len(plan) and (best is None or _chance(plan) > _chance(best[1])):
            best = one, plan
    if best is None:
        outcome = "no safe grasp" if plan is None else plan.summary
        return Pick(look, None, plan, None, float("nan"), outcome)
    # The most probable of all objects' best grasps.
    target, plan = best
    say(plan.summary)
    try:
        width, outcome = execute(cell, plan.best, after)
    except CellError as error:
        return Pick(
            look, target, plan, plan.best, float("nan"), f"not executed to the end: {error}"
        )
    return Pick(look, target, plan, plan.best, width, outcome)


def _chance(plan: GraspPlan) -> float:
    """Return the probability of success of the best grasp."""
    return plan.best.success_probability
