"""Execute a planned grasp in a cell, using only the four methods of `Cell`."""

from collections.abc import Callable

from ..geometry import host_transforms
from ..grasping import PHASES, PlannedGrasp
from ..robots import Command
from ..runtime.array_namespace import to_device
from ..simulation import Cell

EMPTY_FRACTION = 0.5
"""Distance of the closed fingers, over the object's width, below which they hold nothing."""


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
