"""Find the view from which something was changed: a knocked camera, a moved target, another frame.

A set-up that changes once, half-way, is two good data sets that contradict each other. Half of the
views then disagree with the other half, so no single view looks wrong, and medians over pairs of
views may stay small. Therefore the transforms are fitted to the views on one side of every
possible change; if the views on the other side disagree with them, but all by the same transform,
that is the change. A lens that zoomed looks like a camera that moved along its optical axis.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..calibration import mount_frames
from ..geometry import host_logarithms, host_matrices, mean_matrix
from .closure import Poses
from .conventions import MAX_CLOSURE_SCORE, MAX_CORRECTED_SCORE_RATIO
from .transform_fit import fit_transforms, misfit_text, misfits

MIN_VIEWS_ON_A_SIDE = 4
"""Fewest views before and after a change. Of six good views of a real arm, three may agree with a
moved camera by chance."""

MAX_REMAINING_RATIO = 0.5
"""Ratio of the misfit with a change to the misfit without, up to which it is named: it explains
more than all else together."""

MAX_RIVAL_RATIO = 2.0
"""Ratio to the smallest misfit up to which another kind of change explains the views as well."""

MIN_SCORE = 2e-3
"""Smallest score without a change with which one is looked for: 1 mm at half a metre."""

MAX_TRIED_CHANGES = 8
"""Largest number of places where a change is looked for at first; then around the best of them."""

MIN_AXIAL_PART = 0.8
"""Part of a camera's motion along its optical axis from which a zoom is named, too."""


class Change(NamedTuple):
    """A change of the set-up between two views.

    Attributes:
        kind: `"camera"` for the camera against its mount, `"target"` for the target against its
            holder.
        first_view: index of the first view after it.
        translation, rotation: size of the change of the frame, m and rad.
        axial_part: part of the translation along the optical axis, 0 to 1.
        misfit: mean misfit over the views with the change, m and rad.
        score: rotation plus translation over the distance to the target.
    """

    kind: str
    first_view: int
    translation: float
    rotation: float
    axial_part: float
    misfit: tuple[float, float]
    score: float


class ChangeReport(NamedTuple):
    """A change of the set-up, as far as the views tell it, and what it explains.

    Attributes:
        changes: the change that explains the views best, and others that do so about as well.
        misfit: mean misfit over the views without any change, m and rad.
        score: as in `Change`, without any change.
    """

    changes: tuple[Change, ...]
    misfit: tuple[float, float]
    score: float

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right for the views before the change and after it."""
        return (
            self.score > MAX_CLOSURE_SCORE
            and self.changes[0].score < MAX_CORRECTED_SCORE_RATIO * self.score
        )

    def sentence(self, mount: str, view_ids: Sequence[str]) -> str:
        """Return in words what changed, from which view on, and what to do.

        Args:
            mount: where the camera is stated to be.
            view_ids: names of the views.
        """
        best = self.changes[0]
        size = misfit_text((best.translation, best.rotation))
        causes = ", or as if ".join(_causes(change, mount) for change in self.changes)
        return (
            f"from view {view_ids[best.first_view]} on, the views contradict the earlier ones, as "
            f"if {causes}, by {size}: with such a change robot and camera agree to "
            f"{misfit_text(best.misfit)} instead of {misfit_text(self.misfit)} (means over the "
            "views). Calibrate the two parts separately"
        )


def _causes(change: Change, mount: str) -> str:
    """Return what may have been changed, as a clause."""
    in_hand = mount_frames(mount)[0] == "tool"
    if change.kind == "target":
        held = "the target had been moved" + ("" if in_hand else " in the hand")
        frame = "base" if in_hand else "tool"
        return f"{held} (or the controller's {frame} frame changed)"
    held = "the camera had been moved" + (" on the tool" if in_hand else "")
    zoomed = ", or the lens zoomed" if change.axial_part > MIN_AXIAL_PART else ""
    frame = "tool" if in_hand else "base"
    return f"{held} (or the controller's {frame} frame changed{zoomed})"


def find_change(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    length_ratio: float = 1.0,
) -> ChangeReport | None:
    """Return the change that explains most of the disagreement of robot and camera; None without.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`, in the order they were taken.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        length_ratio: of the camera's motion to the robot's. A target of another size than stated
            would otherwise hide a small change.
    """
    views = np.flatnonzero(used)
    if len(views) < 2 * MIN_VIEWS_ON_A_SIDE:
        return None
    robot, camera = host_matrices(mount_from_holder)[views], host_matrices(camera_from_world)[views]
    if not (np.isfinite(robot).all() and np.isfinite(camera).all()):
        return None
    robot[:, :3, 3] *= length_ratio
    distance = float(np.median(np.linalg.norm(camera[:, :3, 3], axis=1)))
    everything = np.ones(len(views), dtype=bool)
    fit = fit_transforms(robot, camera, everything)
    misfit, score = _score(fit.closure, distance)
    if score < MIN_SCORE:
        return None
    places = np.arange(MIN_VIEWS_ON_A_SIDE, len(views) - MIN_VIEWS_ON_A_SIDE + 1)
    coarse = places[np.unique(np.linspace(0, len(places) - 1, MAX_TRIED_CHANGES).astype(int))]
    tried = [change for place in coarse for change in _changes(robot, camera, place, distance)]
    step = int(np.ceil(len(places) / MAX_TRIED_CHANGES))
    if step > 1:
        best = min(tried, key=lambda change: change.score).first_view
        near = np.setdiff1d(places[np.abs(places - best) < step], coarse)
        tried += [change for place in near for change in _changes(robot, camera, place, distance)]
    limit = MAX_REMAINING_RATIO * score
    best_of_kind: dict[str, Change] = {}
    for change in sorted(tried, key=lambda change: change.score):
        if change.score < limit:
            best_of_kind.setdefault(change.kind, change)
    if not best_of_kind:
        return None
    least = min(change.score for change in best_of_kind.values())
    changes = tuple(
        change._replace(first_view=int(views[change.first_view]))
        for change in best_of_kind.values()
        if change.score <= MAX_RIVAL_RATIO * least
    )
    return ChangeReport(changes, misfit, score)


def _changes(robot: Poses, camera: Poses, place: int, distance: float) -> Iterator[Change]:
    """Yield the changes of each kind before the view `place`."""
    after = np.arange(len(robot)) >= place
    # The transforms of the side with more views, from which the other side differs.
    reference = after if 2 * after.sum() >= len(after) else ~after
    fit = fit_transforms(robot, camera, reference)
    on_mount = fit.closure
    on_holder = np.linalg.inv(robot) @ on_mount @ robot
    for kind, closure in (("camera", on_mount), ("target", on_holder)):
        change = mean_matrix(closure[~reference], np.ones(np.count_nonzero(~reference)))
        corrected = closure.copy()
        corrected[~reference] = np.linalg.inv(change) @ closure[~reference]
        misfit, score = _score(corrected, distance)
        twist = host_logarithms(change)
        translation, rotation = misfits(change)[0].tolist()
        along = fit.camera_from_mount[2, :3] @ twist[:3] / max(translation, 1e-12)
        axial_part = abs(float(along)) if kind == "camera" else 0.0
        yield Change(kind, place, translation, rotation, axial_part, misfit, score)


def _score(closure: Poses, distance: float) -> tuple[tuple[float, float], float]:
    """Return the mean misfit, m and rad, and rotation plus translation over the distance."""
    translation, rotation = misfits(closure).mean(axis=0).tolist()
    return (translation, rotation), rotation + translation / distance
