"""Find the views whose robot and camera poses agree with the other views, for use in Step 3.

A picture that is paired with the wrong pose, or was taken while the robot was moving, biases the
hand-eye transform in proportion to its error. Therefore the transforms are computed again without
the view that fits worst; if that view is then an outlier it is left out, and the procedure repeats.

A view may also be an outlier because its own points determine its pose badly: they are few, or all
in one corner of the target. The transforms of the other views then predict its points where they
were seen. Such a view is not used for the transforms, but it is not reported as wrong.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..dataset import MINIMUM_RELIABLE_VIEWS, Observations, chain_residuals, medians_by_view
from ..geometry import host_matrices, host_rotation_angles, host_transforms
from .closure import MAX_CLOSURE_SCORE, Poses
from .largest_group import largest_group
from .picture_turns import turn_of_picture
from .transform_fit import (
    TransformFit,
    fit_transforms,
    mean_misfit,
    median_distance,
    misfit_text,
    misfits,
)

MAX_MISFIT_RATIO = 10.0
"""Limit on a view's misfit in rotation or translation, in multiples of the median view's.

A robot's own errors do not reach it: on nine real data sets the worst view is at one to seven
times."""

MAX_REJECTED_FRACTION = 0.25
"""Largest fraction of the views that is left out; with more the fault is not in single views."""

MISFIT_FLOOR = 1e-3
"""Lower bound of the median view's misfit, rad and as a fraction of the distance to the target.

With nearly exact poses, a view that sees the target badly would otherwise be an outlier by a
negligible amount. Smaller misfits are left for the joint fit to judge.
"""

MAX_REPROJECTION_ERROR_RATIO = 5.0
"""Reprojection error, in multiples of the median view's, up to which a view's points agree with
the transforms of the others. A wrong pose is at tens to hundreds of times."""


OTHER_CORNER_TEXT = "its points are numbered from another corner of the target: number them again"
"""Why a view is left out that fits once it is turned."""


class ViewConsistency(NamedTuple):
    """The result of `find_consistent_views`.

    Attributes:
        consistent: mask of the views that Step 3 uses.
        reasons: by view index, what is wrong with the views that are rejected.
        uncertain: views with an uncertain pose of their own, whose points agree with the others.
    """

    consistent: Bool[np.ndarray, "views"]
    reasons: dict[int, str]
    uncertain: tuple[int, ...]


def find_consistent_views(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    weights: Float[Array, "views"] | Float[np.ndarray, "views"],
    reprojection_error: Callable[[SE3, SE3], Float[np.ndarray, "views"]] | None = None,
    view_ids: Sequence[str] | None = None,
    turns: Float[np.ndarray, "turns 4 4"] | None = None,
) -> ViewConsistency:
    """Find the views that agree, and state what is wrong with the others.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        weights: zero leaves a view out without reporting it.
        reprojection_error: function of `camera_from_mount` and `holder_from_world` that returns the
            reprojection error of each view, px; without it a view's own pose decides.
        view_ids: names of the views in the sentences; by default numbers.
        turns: turns of the target that take its points into each other (`target_turns`), to name
            views that are numbered from another corner.
    """
    weighted = np.asarray(weights) > 0.0
    ids = [str(k) for k in range(len(weighted))] if view_ids is None else view_ids
    consistent, rejected, uncertain = weighted.copy(), [], []
    robot, camera = host_matrices(mount_from_holder), host_matrices(camera_from_world)
    distance = np.linalg.norm(camera[:, :3, 3], axis=1)
    misfit_floor = MISFIT_FLOOR * np.stack([distance, np.ones(len(distance))], axis=1)

    def fit_transforms_to(used: np.ndarray) -> _JudgedFit:
        """Compute the transforms from some views, and the misfits of all views."""
        fit = fit_transforms(robot, camera, used)
        misfit = fit.misfit
        # Misfits are judged relative to the median view, because robots differ in accuracy.
        misfit_scale = np.maximum(np.median(misfit[used], axis=0), misfit_floor)
        return _JudgedFit(fit, misfit, (misfit / misfit_scale).max(axis=1), misfit_scale)

    def errors_with(fit: TransformFit) -> Float[np.ndarray, "views"] | None:
        """Return the reprojection errors of all views with some transforms, px; None if unknown."""
        if reprojection_error is None:
            return None
        return reprojection_error(*map(host_transforms, fit[:2]))

    def leave_out(views: Sequence[int], fit: _JudgedFit) -> None:
        """Sort views that a fit without them contradicts into wrong ones and uncertain ones."""
        errors = errors_with(fit.transforms)
        for view in views:
            # Its points are where the others predict them: its pose is uncertain, not wrong.
            if errors is not None and errors[view] <= MAX_REPROJECTION_ERROR_RATIO * np.median(
                errors[consistent]
            ):
                uncertain.append(view)
            else:
                rejected.append(view)

    hidden = _hidden_views(robot, camera, weighted)
    consistent[hidden] = False
    if len(hidden):
        leave_out(hidden.tolist(), fit_transforms_to(consistent))
    # One view per round, judged by transforms computed without it: a wrong view biases the
    # transforms, and then good views may look worse than it does.
    while (
        consistent.sum() >= MINIMUM_RELIABLE_VIEWS
        and len(rejected) + len(uncertain) < MAX_REJECTED_FRACTION * weighted.sum()
    ):
        worst = int(
            np.argmax(np.where(consistent, fit_transforms_to(consistent).misfit_ratio, 0.0))
        )
        remaining = consistent & (np.arange(len(consistent)) != worst)
        fit = fit_transforms_to(remaining)
        if not fit.misfit_ratio[worst] > MAX_MISFIT_RATIO:
            break
        consistent = remaining
        leave_out([worst], fit)
    # The sentences use transforms without any rejected view: of two exchanged pictures, the
    # second still biased the transforms when the first was rejected.
    fit = fit_transforms_to(consistent)
    errors = errors_with(fit.transforms) if rejected else None
    reasons = {}
    for view in rejected:
        explanation = _explanation(view, fit, robot, camera, ids, turns)
        reasons[view] = f"{_disagreement(view, fit, errors, consistent)}: {explanation}"
    return ViewConsistency(consistent, reasons, tuple(uncertain))


def stale_views(
    groups: Sequence[tuple[int, ...]],
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
) -> dict[int, int]:
    """Return the views whose reported pose is another view's, with the index of that view.

    Args:
        groups: views that were reported with one pose though their pictures differ
            (`contradictory_views`); of each the view that fits the others best is right.
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
    """
    if not groups:
        return {}
    unrepeated = used & ~np.isin(np.arange(len(used)), [view for group in groups for view in group])
    if np.count_nonzero(unrepeated) < 3:
        # A pose that is repeated was read earlier, for the first of its views.
        unrepeated[[group[0] for group in groups]] = True
    robot, camera = host_matrices(mount_from_holder), host_matrices(camera_from_world)
    misfit = fit_transforms(robot, camera, unrepeated).misfit
    distance = np.linalg.norm(np.asarray(camera_from_world.wxyz_xyz)[:, 4:], axis=1)
    score = misfit[:, 0] / distance + misfit[:, 1]
    stale = {}
    for group in groups:
        right = group[int(np.argmin(score[list(group)]))]
        stale |= {view: right for view in group if view != right}
    return stale


def median_reprojection_errors(
    calibration: Calibration,
    observations: Observations,
    inliers: Bool[Array, "views points"] | Bool[np.ndarray, "views points"],
) -> Float[np.ndarray, "views"]:
    """Return the median reprojection error of each view through the whole chain, px.

    It is infinite for a view without visible points.
    """
    errors = np.linalg.norm(np.asarray(chain_residuals(calibration, observations)), axis=2)
    used = np.asarray(inliers)
    return np.where(used.any(axis=1), medians_by_view(errors, used), np.inf)


class _JudgedFit(NamedTuple):
    """The transforms computed from some of the views, and the misfit of every view.

    Attributes:
        transforms: the transforms.
        misfit: translation (m) and rotation (rad) of each view.
        misfit_ratio: the larger of the two in multiples of the median view's.
        misfit_scale: the median misfit, not below `MISFIT_FLOOR`.
    """

    transforms: TransformFit
    misfit: Float[np.ndarray, "views 2"]
    misfit_ratio: Float[np.ndarray, "views"]
    misfit_scale: Float[np.ndarray, "views 2"]


def _disagreement(
    view: int,
    fit: _JudgedFit,
    errors: Float[np.ndarray, "views"] | None,
    consistent: Bool[np.ndarray, "views"],
) -> str:
    """Return by how much a view disagrees with the consistent ones, as a clause.

    Args:
        view: index of the view.
        fit: of the consistent views.
        errors: reprojection errors of all views, px; None if unknown.
        consistent: mask of the consistent views.
    """
    text = (
        f"robot and camera disagree by {misfit_text(fit.misfit[view])} there, "
        f"{fit.misfit_ratio[view]:.0f} times as much as in the median view"
    )
    if errors is None:
        return text
    where = f"{errors[view]:.3g} px off" if np.isfinite(errors[view]) else "out of the picture"
    median_error = np.median(errors[consistent])
    return f"{text}, and its points {where} (the median view's {median_error:.2g} px)"


def _hidden_views(
    robot: Poses, camera: Poses, used: Bool[np.ndarray, "views"]
) -> Int[np.ndarray, "hidden"]:
    """Return the views that a few far worse than all others hide behind each other, by index.

    A fit to all views bends to them, and without the worst of them still to the rest: then none
    stands out. So they are those outside the largest group of views that agree, if nearly all do.
    """
    views, none = np.flatnonzero(used), np.zeros(0, dtype=int)
    if len(views) < MINIMUM_RELIABLE_VIEWS or not np.isfinite([robot[used], camera[used]]).all():
        return none
    distance = median_distance(camera[views])
    closure = fit_transforms(robot, camera, used).closure[views]
    if mean_misfit(closure, distance)[1] < MAX_CLOSURE_SCORE:
        return none
    agreeing = largest_group(robot[views], camera[views], distance)
    if agreeing.sum() < (1.0 - MAX_REJECTED_FRACTION) * len(views):
        return none
    return views[~agreeing]


def _explanation(
    view: int,
    fit: _JudgedFit,
    robot: Poses,
    camera: Poses,
    ids: Sequence[str],
    turns: Float[np.ndarray, "turns 4 4"] | None,
) -> str:
    """Return what may be wrong with a view that contradicts the others, in words."""
    if turns is not None and _fits_turned(view, fit, robot, camera, turns):
        return OTHER_CORNER_TEXT
    distance = float(np.linalg.norm(camera[view, :3, 3]))
    turned = turn_of_picture(fit.transforms, robot[view], camera[view], distance)
    if turned is not None:
        return f"its picture seems to be {turned.text}: {turned.remedy}"
    return _matching_pose_text(view, fit, robot, camera, ids)


def _fits_turned(
    view: int,
    fit: _JudgedFit,
    robot: Poses,
    camera: Poses,
    turns: Float[np.ndarray, "turns 4 4"],
) -> bool:
    """Return whether a view fits if its points are numbered from another corner of the target."""
    camera_from_mount, holder_from_world, _ = fit.transforms
    expected = robot[view] @ holder_from_world
    turned = camera[view] @ turns[1:]
    closure = np.linalg.inv(camera_from_mount) @ turned @ np.linalg.inv(expected)
    return bool(((misfits(closure) / fit.misfit_scale[view]).max(axis=1) < MAX_MISFIT_RATIO).any())


def _matching_pose_text(
    view: int,
    fit: _JudgedFit,
    robot: Poses,
    camera: Poses,
    ids: Sequence[str],
) -> str:
    """Return which other view's pose the picture fits, or that it fits none, in words."""
    camera_from_mount, holder_from_world, _ = fit.transforms
    # The robot pose that this picture needs, from Eq. 10: T = H^-1 C X^-1.
    required = np.linalg.inv(camera_from_mount) @ camera[view] @ np.linalg.inv(holder_from_world)
    offset = required @ np.linalg.inv(robot)
    rotation = host_rotation_angles(offset, np.eye(4))
    translation = np.linalg.norm(offset[:, :3, 3], axis=1)
    misfit = np.stack([translation, rotation], axis=1)
    misfit_ratio = np.where(
        np.arange(len(robot)) == view, np.inf, (misfit / fit.misfit_scale).max(axis=1)
    )
    other = int(np.argmin(misfit_ratio))
    if misfit_ratio[other] < MAX_MISFIT_RATIO:
        return f"it fits the pose of view {ids[other]} ({misfit_text(misfit[other])}): mispaired"
    return "it fits the pose of no other view either: moved, or a wrong pose?"
