"""Find out whether the set-up drifts: a camera or a target that creeps while the views are taken.

A magnetic foot that slips, a mount that sags, a bracket or an arm that warms up: every view is a
little farther from the first one than the view before. No single view looks wrong, and no place
parts good views from bad ones. Both transforms and the drift are fitted to the closure errors of
all views together, linearly, because all are small.

A robot errs alike in poses near each other, and views that are taken along a path then look as if
they drifted. So the errors are white noise plus a Gaussian process over the robot's poses, whose
size and reach are those that make the views most likely, with the drift and without. A drift is
named if it is likely in spite of them, by Schwarz's criterion (`smooth_errors.py` fits the errors).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import mount_frames
from ..dataset import evenly_spaced
from ..geometry import host_logarithms
from .closure import MAX_VIEWS, Poses, contradicts_calibration
from .misfit_evidence import VERY_STRONG_EVIDENCE, evidence, in_parts
from .smooth_errors import LinearFit, ViewErrors, by_transforms, pose_kernels
from .transform_fit import fit_transforms, mean_size, median_distance, misfit_text, motions_of_views


@dataclasses.dataclass(frozen=True)
class DriftOptions:
    """Say which drift of the set-up is named.

    Attributes:
        min_odds: smallest odds of a drift that is named.
        min_views: fewest views: transforms, size and drift have 19 numbers, and 6 views 36.
        min_size: smallest drift from the first view to the last: rotation (rad) plus translation
            over the distance to the target. The default is 1 mm at half a metre.
    """

    min_odds: float = VERY_STRONG_EVIDENCE
    min_views: int = 10
    min_size: float = 2e-3


class SetUpDrift(NamedTuple):
    """A drift of the camera on its mount, or of the target on its holder.

    Attributes:
        kind: `"camera"` or `"target"`.
        views: indices of the first view and of the last that were used.
        translation, rotation: of the drift between these two, m and rad.
        misfit: mean misfit over the views without the drift, m and rad.
        given_misfit: the same with the drift.
        score, given_score: rotation plus translation over the distance to the target, of both.
    """

    kind: str
    views: tuple[int, int]
    translation: float
    rotation: float
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float
    given_score: float

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right for the first views and for the last."""
        return contradicts_calibration(self.score, self.given_score)

    def sentence(self, mount: str, view_ids: Sequence[str]) -> str:
        """Return in words what drifts, by how much, and what to do.

        Args:
            mount: where the camera is stated to be.
            view_ids: names of the views.
        """
        in_hand = mount_frames(mount)[0] == "tool"
        if self.kind == "camera":
            place, frame = ("on the tool", "tool") if in_hand else ("next to the robot", "base")
        else:
            place, frame = ("on the table", "base") if in_hand else ("in the hand", "tool")
        size = misfit_text((self.translation, self.rotation))
        first, last = (view_ids[view] for view in self.views)
        return (
            f"the views drift away from the robot's poses, as if the {self.kind} crept {place} by "
            f"{size} from view {first} to view {last} (or the controller's {frame} "
            "frame drifted, the robot warmed up, or it errs along the path of the views): without "
            f"that, robot and camera agree to {misfit_text(self.misfit)} instead of "
            f"{misfit_text(self.given_misfit)} (means over the views). Fasten camera and target, "
            "let the robot warm up, and take the views again, in mixed order"
        )


def find_drift(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    length_ratio: float = 1.0,
    options: DriftOptions | None = None,
) -> SetUpDrift | None:
    """Return the drift that explains most of the misfit of robot and camera, if there is one.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`, in the order they were taken.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        length_ratio: of the camera's motion to the robot's, as in `find_change`.
        options: which drift is named; by default `DriftOptions()`.
    """
    options = options or DriftOptions()
    views = np.flatnonzero(used)
    if len(views) < options.min_views:
        return None
    views = views[evenly_spaced(len(views), MAX_VIEWS)]
    motions = motions_of_views(mount_from_holder, camera_from_world, views, length_ratio)
    if motions is None:
        return None
    robot, camera = motions
    distance = median_distance(camera)
    fit = fit_transforms(robot, camera)
    at_mount, calibration = host_logarithms(fit.closure), _by_calibration(robot)
    # Views that were left out passed time as well.
    time = 2.0 * (views - views[0]) / (views[-1] - views[0]) - 1.0
    models = {
        kind: np.concatenate([calibration, time[:, None, None] * calibration[..., columns]], axis=2)
        for kind, columns in (("camera", slice(0, 6)), ("target", slice(6, 12)))
    }
    seen = ViewErrors.likelier(at_mount, calibration, robot @ fit.holder_from_world)
    without = seen.white(calibration)
    limit = 2.0 * np.log(options.min_odds)
    left_over = seen.left_over(calibration, without)
    drifts = {kind: seen.white(model) for kind, model in models.items()}
    # Not by errors along one line, as of a flat target's tilt, which creep by chance.
    drifts = {
        kind: drift
        for kind, drift in drifts.items()
        if _odds(without, drift) > limit
        and evidence(in_parts(left_over), in_parts(seen.left_over(models[kind], drift)), 6) > limit
    }
    # A drift is rare: most sets are done with after a look at white errors.
    if not drifts:
        return None
    kernels = pose_kernels(robot)
    smooth = seen.likeliest(calibration, kernels)
    given, given_score = mean_size(left_over, distance)
    candidates = []
    for kind, drift in drifts.items():
        if _odds(smooth, seen.likeliest(models[kind], kernels)) <= limit:
            continue
        # The time runs from -1 to 1.
        (translation, rotation), size = mean_size(2.0 * drift.numbers[None, -6:], distance)
        misfit, score = mean_size(seen.left_over(models[kind], drift), distance)
        if size > options.min_size:
            ends = int(views[0]), int(views[-1])
            sizes = translation, rotation, misfit, given, score, given_score
            candidates.append(SetUpDrift(kind, ends, *sizes))
    return min(candidates, key=lambda drift: drift.score, default=None)


def _odds(without: LinearFit, drifting: LinearFit) -> float:
    """Return twice the logarithm of the odds of a drift, by Schwarz's criterion."""
    return without.likelihood - drifting.likelihood - 6.0 * float(np.log(without.error_count))


def _by_calibration(mount_from_holder: Poses) -> Float[np.ndarray, "views 6 13"]:
    """Return the derivatives of the closure errors by twists of both transforms, and the size.

    The size scales the robot's motion. A wrong one would hide a target that creeps.
    """
    size = np.zeros((len(mount_from_holder), 6, 1))
    size[:, :3, 0] = -mount_from_holder[:, :3, 3]
    return np.concatenate([by_transforms(mount_from_holder), size], axis=2)
