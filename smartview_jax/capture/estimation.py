"""Fit the views taken so far, state the expected error, and propose the views to take next."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration_pipeline import DEFAULT_LENS, CalibrationFit, calibrate
from ..cameras import Camera
from ..dataset import MINIMUM_RELIABLE_VIEWS, Dataset
from ..geometry import host_matrices, host_rotation_angles, host_transforms
from ..io import FolderDescription
from ..joint import SavedEstimate
from ..viewpoints import (
    Situation,
    StopRule,
    ViewLimits,
    ViewPlan,
    ViewRequirements,
    plan_views,
    situation_of_drawing,
    situation_of_estimate,
    viewpoint_commands,
)
from .motion import MotionLimits

FIRST_VIEWS = 15
"""Number of views that are planned from the drawing, before anything is fitted."""

NEXT_VIEWS = 4
"""Number of views that are planned after each fit: a few, because the next fit knows more."""

NEW_POSITION, NEW_ANGLE = 0.02, float(np.deg2rad(5.0))
"""Distance (m) or rotation (rad) from every view at which a pose is another view.

In views that are nearer to each other the same errors of robot and lens come twice.
"""

MIN_FITTED_VIEWS = 4
"""Smallest number of views to which the calibration is fitted."""


@dataclass(frozen=True)
class CaptureOptions:
    """The choices of a person who captures.

    Attributes:
        goal: expected error at which to stop, m.
        start: rough poses of camera and target, by name; without them nothing is proposed before
            the first fit.
        camera: a known camera; None to estimate it.
        motion: limits of the robot's motions; None if it is not to move.
        first_fit: number of views from which on they are fitted.
    """

    goal: float = 4e-4
    limits: ViewLimits = field(default_factory=ViewLimits)
    start: Mapping[str, SE3] | None = None
    camera: Camera | None = None
    lens: str = DEFAULT_LENS
    motion: MotionLimits | None = None
    first_fit: int = MIN_FITTED_VIEWS


class Proposal(NamedTuple):
    """A view to take next.

    Attributes:
        base_from_tool: the pose to command, m.
        is_rough: whether it was planned from the drawing, so that centimetres may be missing.
    """

    base_from_tool: Float[np.ndarray, "4 4"]
    is_rough: bool


class Estimate(NamedTuple):
    """The knowledge after a fit.

    Attributes:
        views: number of views that the fit used.
        error: standard deviation of the position of a point before the camera, m; infinite where
            something is undetermined.
        distance: distance of this point from the camera, m.
        fit: the calibration; None where the fit failed.
        warnings: doubts of the fit, gravest first, or why it failed.
        proposals: views to take next, best first.
        next_errors: error after one, two, and more next views, m; empty where nothing was planned.
    """

    views: int
    error: float
    distance: float
    fit: CalibrationFit | None
    warnings: tuple[str, ...]
    proposals: tuple[Proposal, ...]
    next_errors: tuple[float, ...] = ()

    @property
    def is_reliable(self) -> bool:
        """Whether there are enough views for the error to be believed."""
        return self.views >= MINIMUM_RELIABLE_VIEWS

    def reaches(self, goal: float) -> bool:
        """Return whether the error is small enough, m, and may be believed."""
        return self.is_reliable and self.error <= goal

    def missing_views(self, goal: float) -> int | None:
        """Return about how many more views reach a goal, m; None if that is not known.

        The information of each view is assumed to be the mean of the planned ones: information, one
        over the error squared, adds up.
        """
        # Fewer views than are believed need more, whatever error they state.
        unbelieved = max(MINIMUM_RELIABLE_VIEWS - self.views, 0)
        if self.error <= goal:
            return unbelieved
        if not np.isfinite(self.error) or not self.next_errors:
            return None
        known, wanted, planned = (1.0 / e**2 for e in (self.error, goal, self.next_errors[-1]))
        gained = (planned - known) / len(self.next_errors)
        return max(int(np.ceil((wanted - known) / gained)), unbelieved) if gained > 0.0 else None


def is_near(
    pose: Float[np.ndarray, "*poses 4 4"], places: Float[np.ndarray, "places 4 4"]
) -> Bool[np.ndarray, "*poses"]:
    """Return whether poses are so near to one of some places that they are no other views."""
    pose = pose[..., None, :, :]
    distance = np.linalg.norm(pose[..., :3, 3] - places[:, :3, 3], axis=-1)
    turn = host_rotation_angles(pose, places)
    return ((distance < NEW_POSITION) & (turn < NEW_ANGLE)).any(axis=-1)


def first_proposals(
    described: FolderDescription,
    options: CaptureOptions,
    avoided: Float[np.ndarray, "places 4 4"] | None = None,
) -> tuple[Proposal, ...]:
    """Return the first views, planned from the rough transforms, none near an avoided pose."""
    situation = situation_of_drawing(
        options.start or {},
        described.mount,
        np.asarray(described.target.points),
        described.image_size,
        options.camera,
        options.limits,
    )
    stop = StopRule(FIRST_VIEWS, least_gain=0.0)
    return _proposals(situation, stop, _allowed(options.motion, avoided), True, 0)[0]


def estimate(
    data: Dataset, options: CaptureOptions, avoided: Float[np.ndarray, "places 4 4"] | None = None
) -> Estimate:
    """Fit the views, and plan the next ones; a failed fit is no error: more views will help.

    No view is planned near the avoided poses: views taken, and places the robot did not reach.
    """
    try:
        fit = calibrate(data, options.lens, camera=options.camera)
    except ValueError as error:
        views = data.view_count - len(data.masked_views)
        return Estimate(views, float("inf"), float("nan"), None, (str(error),), ())
    used = int(np.asarray(fit.inliers).any(axis=-1).sum())
    undetermined = fit.observability.null_directions
    if undetermined or not np.isfinite(np.asarray(fit.covariance)).all():
        words = tuple(f"not determined yet: {direction}" for direction in undetermined[:3])
        return Estimate(used, float("inf"), float("nan"), fit, words, ())
    try:
        saved, points = SavedEstimate.of(fit.joint), np.asarray(data.points[0])
        situation = situation_of_estimate(saved, points, options.limits)
        # As long as the error is not believed, it does not end the plan either.
        goal = options.goal if used >= MINIMUM_RELIABLE_VIEWS else None
        stop, allowed = StopRule(NEXT_VIEWS, goal, 0.0), _allowed(options.motion, avoided)
        # Another seed for every number of views: no two plans choose among the same candidates.
        proposals, plan = _proposals(situation, stop, allowed, False, used)
    except ValueError as error:
        return Estimate(used, float("inf"), float("nan"), fit, (str(error),), ())
    return Estimate(used, plan.before, plan.distance, fit, fit.warnings, proposals, plan.values)


def _allowed(
    motion: MotionLimits | None, avoided: Float[np.ndarray, "places 4 4"] | None
) -> Callable[[SE3], Bool[np.ndarray, "poses"]]:
    """Return the function that says which poses may be commanded."""

    def allowed(base_from_tool: SE3) -> Bool[np.ndarray, "poses"]:
        poses = host_matrices(base_from_tool)
        inside = np.array([motion is None or motion.is_inside(pose) for pose in poses], dtype=bool)
        return inside if avoided is None else inside & ~is_near(poses, avoided)

    return allowed


def _proposals(
    situation: Situation,
    stop: StopRule,
    allowed: Callable[[SE3], Bool[np.ndarray, "poses"]],
    is_rough: bool,
    seed: int,
) -> tuple[tuple[Proposal, ...], ViewPlan]:
    """Return proposals and the plan from which they are."""
    plan = plan_views(
        situation.model,
        situation.views,
        stop,
        needs=ViewRequirements(situation.border_margin, allowed=allowed),
        seed=seed,
    )
    if not len(plan.camera_from_world):
        return (), plan
    wanted = host_transforms(plan.camera_from_world)
    commands = viewpoint_commands(situation.calibration, wanted, situation.points)
    poses = host_matrices(commands.base_from_tool)
    return tuple(Proposal(pose, is_rough) for pose in poses), plan
