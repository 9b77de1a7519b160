"""Calibrate a rig: each camera by the staged pipeline, then all of them together."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Unpack

import numpy as np

from .argument_checks import require_instance
from .calibration import Calibration, host_mount_from_holder, transform_names
from .cameras import AbstractLens, Camera
from .data_checks import (
    SeenTarget,
    TargetFindings,
    minimum_points,
    target_findings,
    unusable_views,
)
from .dataset import Dataset, Rig
from .geometry import PoseLike, host_matrices, host_transforms, mean_pose
from .joint import JointOptions, RigFit, fit_rig, remove_gross_errors
from .runtime.double_precision import require_double_precision
from .staged import FewViewsStart, StagedFit, fit_staged, start_by_target

RIG_OPTIONS = ("noise", "field", "fixed", "free", "priors", "robot_prior")
"""The options of `fit_joint` that `fit_rig` has too."""


def calibrate_rig(
    rig: Rig,
    lens: str | AbstractLens,
    *,
    cameras: Mapping[str, Camera] | None = None,
    progress: Callable[[str], None] | None = None,
    **joint_options: Unpack[JointOptions],
) -> RigFit:
    """Calibrate all cameras of a rig together.

    The camera with the most views tells where its target is; other cameras of the same arm that see
    this target start from there. So does a camera whose own views do not tell the place of the
    target, such as one that saw it in a single orientation, and a known camera with one or two
    views.

    Args:
        rig: data sets of the cameras. Each has at least three views; one or two suffice for a known
            camera whose target another camera on the same arm sees in three or more.
        lens: lens model of all cameras.
        cameras: known cameras by name, which are held.
        progress: called with a line of text for each stage.
        joint_options: options of `fit_rig`, by keyword.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: a camera that cannot be calibrated, or cameras that see their common target at
            different places; the message names them. An option of `fit_joint` that a rig does not
            have.
    """
    if unknown := sorted(set(joint_options) - set(RIG_OPTIONS)):
        raise ValueError(
            f"calibrate: a rig takes {', '.join(RIG_OPTIONS)}; found {', '.join(unknown)}"
        )
    require_double_precision()
    require_instance("rig", rig, Rig)
    known = dict(cameras or {})
    if strangers := sorted(set(known) - set(rig.cameras)):
        raise ValueError(
            f"camera: expected cameras of {', '.join(rig.cameras)}, found {', '.join(strangers)}"
        )
    report = progress or (lambda _: None)
    staged: dict[str, StagedFit | FewViewsStart] = {}
    starts: dict[str, Calibration] = {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        counts = usable_view_counts(part, known)
        few = {name: count for name, count in counts.items() if count < 3}
        _require_known(few, known)
        many = [name for name in part.cameras if name not in few]
        of_arm = _staged_fits(part, many, lens, known, report)
        of_few = {name: _placed_by_target(part, name, known[name], of_arm, report) for name in few}
        staged |= {**of_arm, **of_few}
        starts |= _consistent_starts(part, of_arm)
        starts |= {name: start.calibration for name, start in of_few.items()}
    findings = shared_target_findings(rig, staged)
    if findings.problems:
        raise ValueError("; ".join(findings.problems))
    used, rejected = {}, []
    for name, data in rig.cameras.items():
        inliers = data.with_visible(np.asarray(data.visible) & np.asarray(staged[name].inliers))
        used[name], outliers = remove_gross_errors(inliers, starts[name])
        rejected += [(name, entry) for entry in (*staged[name].rejected, *outliers)]
    # In the order of the rig, as are the names of the parameters.
    starts = {name: starts[name] for name in rig.cameras}
    staged = {name: staged[name] for name in rig.cameras}
    fixed = (*joint_options.get("fixed", ()), *(f"{name}.camera" for name in known))
    fit = fit_rig(
        rig.with_cameras(used),
        starts,
        progress=progress,
        rejected=rejected,
        **{**joint_options, "fixed": fixed},
    )
    # A wrong camera makes the places of a target differ as well, so it is named before them.
    of_cameras = [f"{name}: {text}" for name, one in staged.items() for text in one.warnings]
    return dataclasses.replace(fit, warnings=(*of_cameras, *findings.doubts, *fit.warnings))


def shared_target_findings(
    rig: Rig, staged: Mapping[str, StagedFit | FewViewsStart]
) -> TargetFindings:
    """Return the findings about targets that several cameras see, by the cameras' own fits."""
    seen = {}
    for name, fit in staged.items():
        if isinstance(fit, StagedFit):
            views = np.array(fit.views)
            poses = host_matrices(fit.step2.camera_from_world)[views]
            place = host_matrices(fit.calibration.holder_from_world)
            seen[name] = SeenTarget(views, poses, place)
    return target_findings(rig, seen)


def usable_view_counts(rig: Rig, known: Mapping[str, Camera]) -> dict[str, int]:
    """Return the number of usable views of each camera."""
    return {
        name: data.view_count - len(unusable_views(data, minimum_points(known.get(name))))
        for name, data in rig.cameras.items()
    }


def _require_known(few: Mapping[str, int], known: Mapping[str, Camera]) -> None:
    """Raise a ValueError that names a camera with few views whose lens is not known.

    Args:
        few: number of usable views of the cameras that have fewer than three.
        known: known cameras by name.
    """
    for name, count in few.items():
        if name not in known:
            raise ValueError(
                f"camera {name!r}: {count} usable views do not tell its lens: take 3 or more, or "
                f"give the known camera (camera={{{name!r}: ...}}, or --camera FOLDER with a file "
                f"{name}.yaml)"
            )


def _placed_by_target(
    rig: Rig,
    name: str,
    camera: Camera,
    staged: Mapping[str, StagedFit],
    report: Callable[[str], None],
) -> FewViewsStart:
    """Return the place of a known camera with few views, from the target's that others tell.

    Raises:
        ValueError: no other camera sees this target in enough views; the message names the camera.
    """
    reference = _reference(rig, name, staged)
    if reference is None:
        raise ValueError(
            f"camera {name!r}: one or two views tell where it is only if another camera on the "
            f"same arm sees its target {rig.targets[name]!r} in 3 views or more"
        )
    report(f"{name}: from the place of its target that {reference} tells")
    place = staged[reference].calibration.holder_from_world
    try:
        return start_by_target(rig.cameras[name], camera, place)
    except ValueError as error:
        raise ValueError(f"camera {name!r}: {error}") from error


def reference_camera(rig: Rig, camera: str, view_counts: Mapping[str, int]) -> str | None:
    """Return which camera of the same arm tells where a camera's target is, or None.

    It is the camera that sees the target in most views, which may be the camera itself.

    Args:
        rig: data sets of the cameras.
        camera: name of the camera.
        view_counts: number of usable views of each camera that has enough to be calibrated alone.
    """
    seeing = [
        name
        for name in view_counts
        if rig.targets[name] == rig.targets[camera] and rig.arms[name] == rig.arms[camera]
    ]
    return max(seeing, key=lambda name: view_counts[name], default=None)


def _reference(rig: Rig, camera: str, staged: Mapping[str, StagedFit]) -> str | None:
    """Return which camera with a staged fit tells where a camera's target is, or None."""
    return reference_camera(rig, camera, {name: len(fit.views) for name, fit in staged.items()})


def _staged_fits(
    rig: Rig,
    cameras: Sequence[str],
    lens: str | AbstractLens,
    known: Mapping[str, Camera],
    report: Callable[[str], None],
) -> dict[str, StagedFit]:
    """Return the staged fit of each camera alone, or from the target's place that others tell.

    Args:
        rig: data sets of one arm's cameras.
        cameras: names of the cameras to fit.
        lens, known, report: as for `calibrate_rig`.

    Raises:
        ValueError: a camera that cannot be calibrated; the message names it.
    """
    staged: dict[str, StagedFit] = {}
    errors: dict[str, ValueError] = {}

    def fit(name: str, start: dict[str, PoseLike] | None) -> None:
        """Fit one camera, or keep the error."""
        try:
            staged[name] = fit_staged(
                rig.cameras[name],
                lens,
                camera=known.get(name),
                start=start,
                progress=lambda text: report(f"{name}: {text}"),
            )
        except ValueError as error:
            # The first error tells more: the second is about a start that nobody gave.
            errors.setdefault(name, error)

    for name in cameras:
        fit(name, None)
    for name in list(errors):
        most = _reference(rig, name, staged)
        if most is not None:
            report(f"{name}: again, from the place of its target that {most} tells")
            place = staged[most].calibration.holder_from_world
            fit(name, {transform_names(rig.cameras[name].mount)[1]: place})
        if name not in staged:
            raise ValueError(f"camera {name!r}: {errors[name]}") from errors[name]
    return {name: staged[name] for name in cameras}


def _consistent_starts(rig: Rig, staged: Mapping[str, StagedFit]) -> dict[str, Calibration]:
    """Return the calibrations of the staged fits, with one pose for each target."""
    starts = {name: fit.calibration for name, fit in staged.items()}
    for name in staged:
        first = _reference(rig, name, staged)
        if first is not None and name != first:
            starts[name] = _with_target_at(starts[first], rig.cameras[name], staged[name])
    return starts


def _with_target_at(reference: Calibration, data: Dataset, staged: StagedFit) -> Calibration:
    """Return a camera's calibration for a target whose pose another camera tells.

    Its mount follows from the poses in which the camera sees the target, averaged over its views.
    """
    views = np.array(staged.views)
    holder_from_world = host_matrices(reference.holder_from_world)
    mount_from_holder = host_matrices(host_mount_from_holder(data.mount, data.base_from_tool))
    seen = host_matrices(staged.step2.camera_from_world)[views]
    mounts = seen @ np.linalg.inv(mount_from_holder[views] @ holder_from_world)
    return dataclasses.replace(
        staged.calibration,
        camera_from_mount=mean_pose(host_transforms(mounts)),
        holder_from_world=reference.holder_from_world,
    )
