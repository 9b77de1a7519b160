"""Calibrate a rig: each camera by the staged pipeline, then all of them together."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Unpack

import numpy as np
from jaxlie import SE3

from .argument_checks import errors_at, require_instance
from .calibration import Calibration, host_mount_from_holder, transform_names
from .cameras import AbstractLens, Camera
from .data_checks import (
    SeenTarget,
    TargetFindings,
    exchanged_cameras,
    minimum_points,
    target_findings,
    unusable_views,
)
from .dataset import Dataset, Rig, arms_of, digests_to_keep, is_pair
from .engine import with_lens
from .fit_result import Rejection
from .geometry import PoseLike, host_matrices, host_transforms, mean_pose
from .joint import JointOptions, RigFit, fit_rig, remove_gross_errors
from .runtime.double_precision import require_double_precision
from .staged import (
    FewViewsStart,
    StagedFit,
    check_start,
    fit_staged,
    known_transforms,
    merged_start,
    start_by_target,
    with_start_doubts,
)

AnyStart = Calibration | Mapping[str, PoseLike] | None
"""The start of a camera: a calibration, or some of its transforms by name."""

RigStart = Mapping[str, Calibration | Mapping[str, PoseLike]]
"""The starts of some of a rig's cameras, by their names."""

SAME_PLACE = 1e-6
"""Largest difference, m or no unit, of two poses that are meant to be one target's."""

RIG_OPTIONS = ("noise", "field", "fixed", "free", "priors", "robot_prior", "devices")
"""The options of `fit_joint` that `fit_rig` has too."""


def calibrate_rig(
    rig: Rig,
    lens: str | AbstractLens,
    *,
    cameras: Mapping[str, Camera] | None = None,
    start: RigStart | None = None,
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
        start: where the joint fit starts, for some of the cameras by name, as `calibrate` takes it
            for one camera; of a calibration its camera and its transforms. Of one target one pose
            can be given.
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
    given = _checked_starts(rig, start, lens)
    report = progress or (lambda _: None)
    paths = (*joint_options.get("fixed", ()), *(joint_options.get("priors") or {}))
    staged: dict[str, StagedFit | FewViewsStart] = {}
    starts: dict[str, Calibration] = {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        counts = usable_view_counts(part, known)
        few = {name: count for name, count in counts.items() if count < 3}
        _require_known(few, known)
        _refuse_few_of_pair(few, arm)
        many = [name for name in part.cameras if name not in few]
        of_arm = _staged_fits(part, many, lens, known, given, report)
        for name in of_arm:
            of_arm[name], given[name] = with_start_doubts(
                of_arm[name], given[name], part.cameras[name], _own_paths(rig, name, paths)
            )
        _refuse_unused_places(part, few, start or {})
        own_starts = _consistent_starts(part, of_arm, known, given)
        of_few = {
            name: _placed_by_target(part, name, known[name], of_arm, own_starts, report)
            for name in few
        }
        staged |= {**of_arm, **of_few}
        starts |= own_starts
        starts |= {
            name: _with_given_mount(placed.calibration, given[name])
            for name, placed in of_few.items()
        }
    # In the order of the rig, as are the names of the parameters.
    starts = {name: starts[name] for name in rig.cameras}
    starts = _with_common_pairs(rig, staged, starts, given)
    findings = shared_target_findings(rig, staged)
    if findings.problems:
        raise ValueError("; ".join(findings.problems))
    used, rejected = _without_gross_errors(rig, staged, starts)
    fixed = (*joint_options.get("fixed", ()), *(f"{name}.camera" for name in known))
    fit = fit_rig(
        used,
        starts,
        progress=progress,
        rejected=rejected,
        **{**joint_options, "fixed": fixed},
    )
    # A wrong camera makes the places of a target differ as well, so it is named before them.
    of_cameras = [f"{name}: {text}" for name in rig.cameras for text in staged[name].warnings]
    return dataclasses.replace(
        fit,
        data=rig,
        warnings=(*of_cameras, *findings.doubts, *fit.warnings),
        # Of the pictures with all their points, also those that were left out.
        picture_digests={name: digests_to_keep(data) for name, data in rig.cameras.items()},
    )


def _without_gross_errors(
    rig: Rig,
    staged: Mapping[str, StagedFit | FewViewsStart],
    starts: Mapping[str, Calibration],
) -> tuple[Rig, list[tuple[str, Rejection]]]:
    """Return the rig without gross errors, and what the cameras' own fits and this left out."""
    used, rejected = {}, []
    for name, data in rig.cameras.items():
        inliers = data.with_visible(np.asarray(data.visible) & np.asarray(staged[name].inliers))
        used[name], outliers = remove_gross_errors(inliers, starts[name])
        rejected += [(name, entry) for entry in (*staged[name].rejected, *outliers)]
    return rig.with_cameras(used), rejected


def shared_target_findings(
    rig: Rig, staged: Mapping[str, StagedFit | FewViewsStart]
) -> TargetFindings:
    """Return the findings about targets that several cameras see, by the cameras' own fits."""
    return target_findings(rig, _seen_targets(staged))


def _seen_targets(
    staged: Mapping[str, StagedFit | FewViewsStart],
) -> dict[str, SeenTarget]:
    """Return the target as each camera sees it that has a fit of its own."""
    seen = {}
    for name, fit in staged.items():
        if isinstance(fit, StagedFit):
            views = np.array(fit.views)
            poses = host_matrices(fit.step2.camera_from_world)[views]
            place = host_matrices(fit.calibration.holder_from_world)
            seen[name] = SeenTarget(views, poses, place)
    return seen


def usable_view_counts(rig: Rig, known: Mapping[str, Camera]) -> dict[str, int]:
    """Return the number of usable views of each camera."""
    return {
        name: data.view_count - len(unusable_views(data, minimum_points(known.get(name))))
        for name, data in rig.cameras.items()
    }


def _require_known(few: Mapping[str, int], known: Mapping[str, Camera]) -> None:
    """Raise a ValueError that names a camera with few usable views whose lens is not known."""
    for name, count in few.items():
        if name not in known:
            raise ValueError(
                f"camera {name!r}: {count} usable views do not tell its lens: take 3 or more, or "
                f"give the known camera (camera={{{name!r}: ...}}, or --camera FOLDER with a file "
                f"{name}.yaml)"
            )


def _refuse_few_of_pair(few: Mapping[str, int], arm: str) -> None:
    """Raise a ValueError that names a camera of a pair of arms with few usable views."""
    for name, count in few.items():
        if is_pair(arm):
            raise ValueError(
                f"camera {name!r}: {count} usable views do not tell where the bases of "
                f"{' and '.join(arms_of(arm))} are: take 3 or more"
            )


def _placed_by_target(
    rig: Rig,
    name: str,
    camera: Camera,
    staged: Mapping[str, StagedFit],
    starts: Mapping[str, Calibration],
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
    place = starts[reference].holder_from_world
    with errors_at(f"camera {name!r}"):
        return start_by_target(rig.cameras[name], camera, place)


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
    starts: Mapping[str, AnyStart],
    report: Callable[[str], None],
) -> dict[str, StagedFit]:
    """Return the staged fit of each camera alone, or from the target's place that others tell.

    Raises:
        ValueError: a camera that cannot be calibrated; the message names it.
    """
    staged: dict[str, StagedFit] = {}
    errors: dict[str, ValueError] = {}

    def fit(name: str, start: AnyStart) -> None:
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
        fit(name, starts[name])
    for name in list(errors):
        most = _reference(rig, name, staged)
        if most is not None:
            report(f"{name}: again, from the place of its target that {most} tells")
            place = staged[most].calibration.holder_from_world
            fit(name, {transform_names(rig.cameras[name].mount)[1]: place})
        if name not in staged:
            exchanged = _exchanged_pictures(rig, cameras, lens, known)
            text = exchanged or f"camera {name!r}: {errors[name]}"
            raise ValueError(text) from errors[name]
    told = doubts_told_by_others(rig, staged)
    return {
        name: dataclasses.replace(
            staged[name],
            warnings=tuple(text for text in staged[name].warnings if text not in told[name]),
        )
        for name in cameras
    }


def doubts_told_by_others(
    rig: Rig, staged: Mapping[str, StagedFit | FewViewsStart]
) -> dict[str, tuple[str, ...]]:
    """Return for each camera the doubts about its motion that another camera's views end.

    Few views may not tell in which direction the poses are, or how large the target is. A camera of
    the same arm that sees the same target from more sides tells both.
    """
    reports = {name: fit.conventions for name, fit in staged.items() if isinstance(fit, StagedFit)}
    certain = {
        name: _used_views(staged[name]) for name, report in reports.items() if report.is_certain
    }
    return {
        name: () if reference_camera(rig, name, certain) is None else report.ambiguities
        for name, report in reports.items()
    }


def _exchanged_pictures(
    rig: Rig, cameras: Sequence[str], lens: str | AbstractLens, known: Mapping[str, Camera]
) -> str:
    """Return a sentence if cameras that cannot be calibrated have exchanged pictures, else nothing.

    Their poses in each view come from the pictures alone, however the robot moves.
    """
    staged: dict[str, StagedFit | FewViewsStart] = {}
    for name in cameras:
        with suppress(ValueError):
            data, camera = rig.cameras[name], known.get(name)
            staged[name] = fit_staged(data, lens, camera=camera, conventions="report")
    return "; ".join(exchanged_cameras(rig, _seen_targets(staged)))


def _consistent_starts(
    rig: Rig,
    staged: Mapping[str, StagedFit],
    known: Mapping[str, Camera],
    given: Mapping[str, AnyStart],
) -> dict[str, Calibration]:
    """Return the calibrations of the staged fits, or what is given, with one pose for each target.

    Args:
        rig: data sets of one arm's cameras.
        staged: the cameras' staged fits.
        known: known cameras by name.
        given: start of each camera, None without one.
    """
    starts = {
        name: merged_start(fit.calibration, given[name], rig.cameras[name], known.get(name))
        for name, fit in staged.items()
    }
    for name in staged:
        first = _placing_camera(rig, name, staged, given)
        if first is not None and name != first:
            placed = _with_target_at(starts[first], rig.cameras[name], staged[name])
            starts[name] = _with_given_mount(
                dataclasses.replace(placed, camera=starts[name].camera), given[name]
            )
    return starts


def _with_common_pairs(
    rig: Rig,
    staged: Mapping[str, StagedFit | FewViewsStart],
    starts: Mapping[str, Calibration],
    given: Mapping[str, AnyStart],
) -> dict[str, Calibration]:
    """Return the starts with one pose for each target on a hand, and for the bases of each pair.

    A target is where cameras next to its arm see it, if there are any; otherwise, as the bases of a
    pair are, where the pair's camera with the most views puts it.

    Args:
        rig: data sets of the cameras.
        staged: the cameras' staged fits.
        starts: start of each camera, with one pose for each target of one arm.
        given: start of each camera that the user gave, None without one.
    """
    common = dict(starts)
    poses: dict[str, SE3] = {}
    bases: dict[str, SE3] = {}
    for name in sorted(starts, key=lambda camera: -_used_views(staged[camera])):
        if starts[name].mount == "eye_to_hand":
            poses.setdefault(rig.targets[name], starts[name].holder_from_world)
    pairs = [name for name in starts if is_pair(rig.arms[name])]
    for name in sorted(pairs, key=lambda camera: -_used_views(staged[camera])):
        start, fit = starts[name], staged[name]
        assert isinstance(fit, StagedFit)
        assert start.base_from_other_base is not None
        pose = poses.setdefault(rig.targets[name], start.holder_from_world)
        base = bases.setdefault(rig.arms[name], start.base_from_other_base)
        if pose is start.holder_from_world and base is start.base_from_other_base:
            continue
        placed = dataclasses.replace(start, holder_from_world=pose, base_from_other_base=base)
        moved = _with_target_at(placed, rig.cameras[name].with_bases(base), fit)
        placed = dataclasses.replace(placed, camera_from_mount=moved.camera_from_mount)
        common[name] = _with_given_mount(placed, given[name])
    return common


def _used_views(staged: StagedFit | FewViewsStart) -> int:
    """Return the number of views that a start comes from."""
    return len(staged.views) if isinstance(staged, StagedFit) else 0


def _placing_camera(
    rig: Rig, camera: str, staged: Mapping[str, StagedFit], starts: Mapping[str, AnyStart]
) -> str | None:
    """Return which camera tells where a camera's target is: one with a given pose, or most views.

    Raises:
        ValueError: two cameras are given different poses of it.
    """
    target = rig.targets[camera]
    poses = {
        name: pose
        for name in staged
        if rig.targets[name] == target
        and (pose := known_transforms(starts[name], rig.cameras[name].mount)[1]) is not None
    }
    if not poses:
        return _reference(rig, camera, staged)
    first, *others = poses
    for other in others:
        difference = np.abs(host_matrices(poses[first]) - host_matrices(poses[other])).max()
        if difference > SAME_PLACE:
            raise ValueError(
                f"start: cameras {first!r} and {other!r} see one target, {target!r}, but their "
                f"starts place it differently, by {difference:.2g}: give one of them"
            )
    return first


def _refuse_unused_places(rig: Rig, few: Mapping[str, int], start: RigStart) -> None:
    """Raise a ValueError for a target's pose that is given for a camera with few usable views."""
    for name in few:
        given, place = start.get(name), transform_names(rig.cameras[name].mount)[1]
        if isinstance(given, Mapping) and place in given:
            raise ValueError(
                f"camera {name!r}: start: {place}: its few views start from the target that "
                "another camera tells: give it for that camera"
            )


def _with_given_mount(calibration: Calibration, start: AnyStart) -> Calibration:
    """Return a calibration with the camera's transform of a start, if it has one."""
    mount = known_transforms(start, calibration.mount)[0]
    return (
        calibration if mount is None else dataclasses.replace(calibration, camera_from_mount=mount)
    )


def _checked_starts(
    rig: Rig, start: RigStart | None, lens: str | AbstractLens
) -> dict[str, AnyStart]:
    """Return the start of each camera, None without one; a calibration with the lens to fit.

    Raises:
        ValueError: a start of a camera that the rig does not have, or not of its data.
    """
    given = dict(start or {})
    if strangers := sorted(set(given) - set(rig.cameras)):
        raise ValueError(
            f"start: expected cameras of {', '.join(rig.cameras)}, found {', '.join(strangers)}"
        )
    for name, camera_start in given.items():
        with errors_at(f"camera {name!r}"):
            check_start(camera_start, rig.cameras[name])
        if isinstance(camera_start, Calibration):
            bare = Calibration(
                camera_start.camera,
                camera_start.camera_from_mount,
                camera_start.holder_from_world,
                camera_start.mount,
                base_from_other_base=camera_start.base_from_other_base,
            )
            given[name] = with_lens(bare, lens)
    return {name: given.get(name) for name in rig.cameras}


def _own_paths(rig: Rig, camera: str, paths: Sequence[str]) -> tuple[str, ...]:
    """Return the paths of a rig's parameters that concern a camera, in its own names."""
    several = len(set(rig.targets.values())) > 1
    prefixes = (f"{camera}.", f"{rig.targets[camera]}." if several else "")
    return tuple(
        path.removeprefix(prefix)
        for path in paths
        for prefix in prefixes
        if path.startswith(prefix)
    )


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
