"""Ask what is wrong with data in the order of the chain, so that the first fault is the one named.

A fault of one link makes all later ones look wrong: poses that were not read again look like wrong
conventions, a lens that the model cannot bend to looks like a robot that errs, and any of them like
a target of another size. So each question concerns only the views that the earlier ones left, and
of several faults the first is named first.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..dataset import repetition_warnings
from ..fit_result import Rejection

MAX_NAMED_VIEWS = 5
"""Largest number of views that a sentence names with their reasons."""


class Findings(NamedTuple):
    """The answers to the questions, in sentences that say what is wrong; empty where nothing is.

    Attributes:
        poses: Was each pose read for its own picture? Views for which it was not are left out.
            (That the robot moved and turned at all is asked before any fit, by `require_motion`.)
        detections: Does each detection fit its own target? Views that do not are left out.
        camera: Does a camera fit the views that are left, without any robot?
        motions: Do robot and camera move alike, and if they do, are the lengths of target and robot
            in one unit? `check_conventions` asks in this order.
        motions_explained: whether they move alike but for the mistake that `motions` names, so that
            it is likelier than a camera that makes them differ.
    """

    poses: tuple[str, ...]
    detections: tuple[str, ...]
    camera: tuple[str, ...]
    motions: tuple[str, ...]
    motions_explained: bool = False

    @property
    def problems(self) -> tuple[str, ...]:
        """Why the data cannot be calibrated, the likeliest fault first; empty if they can.

        A camera that does not fit well is a doubt as long as the robot moves as it says. If it does
        not, either may be the cause of both.
        """
        if not self.motions:
            return ()
        both = (*self.motions, *self.camera)
        if self.camera and not self.motions_explained:
            seen_wrong = (f"as seen with this camera, {text}" for text in self.motions)
            both = (*self.camera, *seen_wrong)
        return (*self.poses, *self.detections, *both)


def pose_findings(reasons: Mapping[int, str], view_ids: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence on the views whose pose was not read again, if there are any.

    Args:
        reasons: why views are left out, by their index.
        view_ids: names of the views.
    """
    return tuple(
        repetition_warnings([Rejection(view_ids[v], None, text) for v, text in reasons.items()])
    )


def detection_findings(reasons: Mapping[int, str], view_ids: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence on the views that do not show the target, if there are any."""
    if not reasons:
        return ()
    named = [f"view {view_ids[view]}: {text}" for view, text in reasons.items()]
    more = len(named) - MAX_NAMED_VIEWS
    return ("; ".join(named[:MAX_NAMED_VIEWS]) + (f"; and {more} more views" if more > 0 else ""),)
