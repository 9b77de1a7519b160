"""Say in words what may have been moved, for every check that finds a change of the set-up."""

from ..calibration import mount_frames
from .transform_fit import misfit_text


def moved_text(kind: str, mount: str, size: tuple[float, float]) -> str:
    """Return what may have been moved, and by how much, as a clause.

    Args:
        kind: `"camera"` for the camera against its mount, `"target"` for the target against its
            holder.
        mount: where the camera is stated to be.
        size: translation (m) and rotation (rad) of the change.
    """
    in_hand = mount_frames(mount)[0] == "tool"
    if kind == "target":
        held = "the target had been moved" + ("" if in_hand else " in the hand")
        frame = "base" if in_hand else "tool"
    else:
        held = "the camera had been moved" + (" on the tool" if in_hand else "")
        frame = "tool" if in_hand else "base"
    return f"{held} (or the controller's {frame} frame changed) by {misfit_text(size)}"
