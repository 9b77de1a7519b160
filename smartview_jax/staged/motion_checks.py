"""Compare how robot and camera move, before Step 3: leave wrong views out, and name mistakes.

A wrong convention makes A X = X B meaningless, and the transforms that minimise Eq. 17 would still
look like an answer. So the poses of Step 2 are compared with the robot's here.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..data_checks import (
    CameraDoubt,
    CameraMisfit,
    ConventionReport,
    Findings,
    ResizedPictures,
    RobotAndCamera,
    SeenDistances,
    SharedFault,
    check_conventions,
    detection_findings,
    find_joint_share,
    find_other_arm,
    find_shared_fault,
    find_shifted_numbering,
    joint_problem,
    pose_findings,
    shift_text,
    stale_views,
    stuck_joints,
    target_turns,
)
from ..dataset import Dataset, contradictory_views, repeated_pose_reason
from .common_camera import PictureFit
from .picture_parts import has_views_of_other_camera, resized_pictures
from .picture_steps import pixel_noise
from .two_poses import PoseChoice, choose_poses


class PairedViews(NamedTuple):
    """The views whose picture and robot pose may belong together.

    Attributes:
        pictures: Steps 1 and 2; `used` is without the views that are left out here.
        stale: views whose robot pose repeats another view's, with the reason.
        renumbered: views whose points are numbered otherwise, with the reason.
        choice: the poses of a small target, where a picture leaves two; None for other targets.
    """

    pictures: PictureFit
    stale: dict[int, str]
    renumbered: dict[int, str]
    choice: PoseChoice | None

    @property
    def mispaired(self) -> dict[int, str]:
        """Views whose robot pose cannot belong to their picture, with the reason."""
        return self.choice.outlying if self.choice is not None and self.choice.explained else {}


class MotionChecks(NamedTuple):
    """The report on the motion, and the doubts about camera and target.

    Attributes:
        report: how robot and camera move, and the problems of poses and pictures.
        camera_doubt: what is wrong with one camera for all views, or None.
        doubts: sentences about the camera and the target.
        turns: turns in its plane that take the target into itself, or None.
    """

    report: ConventionReport
    camera_doubt: CameraDoubt | None
    doubts: tuple[str, ...]
    turns: Float[np.ndarray, "turns 4 4"] | None


def pair_views(
    data: Dataset, pictures: PictureFit, known: tuple[SE3 | None, SE3 | None]
) -> PairedViews:
    """Leave out views whose pose or numbering is wrong, and choose between a small target's poses.

    Args:
        data: the data set.
        pictures: Steps 1 and 2.
        known: the transforms of the start, as far as they are known.
    """
    robot = data.mount_from_holder
    groups = contradictory_views(data.mask_views(list(pictures.unusable)))
    repeated = stale_views(groups, robot, pictures.common.camera_from_world, pictures.used)
    stale = {view: repeated_pose_reason(data, view, other) for view, other in repeated.items()}
    pictures = _without(pictures, stale)
    choice = choose_poses(
        pictures.observations,
        pictures.common.camera,
        pictures.common.camera_from_world,
        robot,
        pictures.used,
        pixel_noise(pictures.common),
        known,
    )
    if choice is not None:
        if choice.exchanged:
            pictures.steps.say(f"Step 2 again: {len(choice.exchanged)} views have their other pose")
            common = pictures.step2_from(pictures.common.camera, choice.camera_from_world)
            pictures = pictures._replace(common=common)
        return PairedViews(pictures, stale, {}, choice)
    shifts = find_shifted_numbering(
        robot,
        pictures.common.camera_from_world,
        pictures.used,
        np.asarray(data.points),
        np.asarray(pictures.common.inliers),
    )
    renumbered = {view: shift_text(shift) for view, shift in shifts.items()}
    return PairedViews(_without(pictures, renumbered), stale, renumbered, None)


def _without(pictures: PictureFit, views: dict[int, str]) -> PictureFit:
    """Return the fit with some views not used."""
    used = pictures.used.copy()
    used[list(views)] = False
    return pictures._replace(used=used)


def check_motion(data: Dataset, views: PairedViews) -> MotionChecks:
    """Return whether robot and camera move alike, and what is wrong with the pictures."""
    pictures, common, used = views.pictures, views.pictures.common, views.pictures.used
    turns = target_turns(np.asarray(data.points), np.asarray(pictures.observations.visible))
    misfit, resized = pictures.misfit(used), None
    report = check_conventions(
        data.base_from_tool,
        common.camera_from_world,
        data.mount,
        used.astype(float),
        turns,
        data.view_ids,
        # A wrong convention chooses wrong ones of two poses, which then look like noise.
        may_be_inaccurate=misfit is None and views.choice is None,
    )
    # The poses of a small target scatter by more than the check allows for.
    is_small_target = views.choice is not None and views.choice.explained
    if is_small_target:
        report = report._replace(problems=(), hypotheses=(), explained=False, inaccuracy="")
    if not (is_small_target or report.explained):
        report = _with_mistake_in_joints(report, data, common.camera_from_world, used)
    if not report.explained:
        report, resized = _with_fault_of_many_views(report, data, pictures, misfit)
    if resized is not None and misfit is not None:
        camera_doubt, doubts = CameraDoubt(report.change, misfit), ()
    else:
        camera_doubt, doubts = pictures.doubts(used, misfit)
    # A target that bends does not hide a mistake that explains how robot and camera move.
    is_explained = report.explained or bool(report.change)
    findings = Findings(
        pose_findings(pictures.unusable | views.stale, data.view_ids),
        detection_findings(pictures.mismatched, data.view_ids),
        () if misfit is None and is_explained else doubts,
        report.problems,
        is_explained,
    )
    report = report._replace(problems=findings.problems)
    if camera_doubt is None and pictures.stretched is not None:
        camera_doubt = pictures.stretched.doubt
        doubts = (camera_doubt.text,)
    return MotionChecks(report, camera_doubt, doubts, turns)


def _with_mistake_in_joints(
    report: ConventionReport, data: Dataset, camera_from_world: SE3, used: np.ndarray
) -> ConventionReport:
    """Return the report with a mistake in the joint readings, or with another arm, if it has one.

    Another arm may look like a target of another size.
    """
    if data.joints is None or data.arm is None:
        return report
    readings, text = np.asarray(data.joints), ""
    if report.is_contradicted:
        text = joint_problem(readings, data.arm, camera_from_world, data.mount, used)
    if not text:
        lengths = find_other_arm(readings, data.arm, camera_from_world, data.mount, used)
        text = "" if lengths is None else lengths.sentence
    if text:
        return report._replace(problems=(text,), explained=True, inaccuracy="")
    stuck = stuck_joints(readings, used, data.view_ids) if report.is_contradicted else ""
    if not stuck:
        return report
    return report._replace(problems=(stuck, *report.problems), inaccuracy="")


def _with_fault_of_many_views(
    report: ConventionReport,
    data: Dataset,
    pictures: PictureFit,
    misfit: CameraMisfit | None,
) -> tuple[ConventionReport, ResizedPictures | None]:
    """Return the report with the one fault that makes many views wrong, if there is one.

    It is a problem where no calibration can be right with it, else a doubt. A camera that does not
    fit puts targets at wrong distances, so that nothing tells whether its focus changes.

    Args:
        report: without it.
        data: the data set.
        pictures: Steps 1 and 2.
        misfit: of the common camera; None if it fits.

    Returns:
        The report; and the pictures that were resized, if these are the fault.
    """
    poses = RobotAndCamera(
        data.base_from_tool,
        pictures.common.camera_from_world,
        data.mount,
        data.view_ids,
        report.length_ratio,
    )
    if misfit is None:
        distances = SeenDistances.of_points(
            np.asarray(data.points),
            np.asarray(data.pixels),
            np.asarray(pictures.common.inliers),
            pixel_noise(pictures.common),
        )
        poses = poses._replace(distances=distances)
    fault, resized = _shared_fault(data, poses, pictures.used), None
    is_doubtful = fault is not None or report.is_contradicted or misfit is not None
    if is_doubtful or has_views_of_other_camera(pictures):
        first_view = 0 if fault is None else fault.first_view
        resized = resized_pictures(pictures, data.mount_from_holder, first_view, misfit)
    if resized is not None and fault is not None and fault.score <= resized.score:
        resized = None
    if resized is not None:
        fault = SharedFault(resized.sentence(data.view_ids), resized.contradicts, True)
    if fault is None:
        return report, None
    report = report._replace(change=fault.sentence)
    if fault.contradicts:
        report = report._replace(problems=(fault.sentence,), inaccuracy="")
    return report, resized


def _shared_fault(data: Dataset, poses: RobotAndCamera, used: np.ndarray) -> SharedFault | None:
    """Return the fault of many views that explains them best, also one of a joint where known."""
    fault = find_shared_fault(poses, used)
    if data.joints is None or data.arm is None:
        return fault
    joint = find_joint_share(
        np.asarray(data.joints), data.arm, poses.camera_from_world, data.mount, used
    )
    if joint is None or (fault is not None and fault.score <= joint.score):
        return fault
    return SharedFault(joint.sentence, joint.contradicts, True, score=joint.score)
