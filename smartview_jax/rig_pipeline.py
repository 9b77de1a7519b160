"""Calibrate a rig: each camera by the staged pipeline, then all of them together."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Unpack

import numpy as np

from .argument_checks import require_instance
from .calibration import Calibration, transform_names
from .cameras import AbstractLens, Camera
from .data_checks import (
    SeenTarget,
    TargetFindings,
    exchanged_cameras,
    minimum_points,
    target_findings,
    unusable_views,
)
from .dataset import Rig, arms_of, digests_to_keep, is_pair
from .fit_result import Rejection
from .geometry import host_matrices
from .joint import JointOptions, RigFit, fit_rig, remove_gross_errors
from .rig_starts import (
    AnyStart,
    RigStart,
    camera_with_most_views,
    checked_starts,
    consistent_starts,
    own_paths,
    placed_by_target,
    reference_camera,
    refuse_unused_places,
    used_view_count,
    with_common_pairs,
    with_given_mount,
)
from .runtime.double_precision import require_double_precision
from .staged import (
    FewViewsStart,
    StagedFit,
    fit_staged,
    with_start_doubts,
)

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
    given = checked_starts(rig, start, lens)
    report = progress or (lambda _: None)
    paths = (*joint_options.get("fixed", ()), *(joint_options.get("priors") or {}))
    staged: dict[str, StagedFit | FewViewsStart] = {}
    starts: dict[str, Calibration] = {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        few = _few_views(part, arm, known)
        refuse_unused_places(part, few, start or {})
        many = [name for name in part.cameras if name not in few]
        of_arm = _staged_fits(part, many, lens, known, given, report)
        for name in of_arm:
            of_arm[name], given[name] = with_start_doubts(
                of_arm[name], given[name], part.cameras[name], own_paths(rig, name, paths)
            )
        starts |= consistent_starts(part, of_arm, known, given)
        staged |= of_arm
        for name in few:
            placed = placed_by_target(part, name, known[name], of_arm, starts, report)
            starts[name] = with_given_mount(placed.calibration, given[name])
            staged[name] = placed
    # In the order of the rig, as are the names of the parameters.
    starts = {name: starts[name] for name in rig.cameras}
    starts = with_common_pairs(rig, staged, starts, given)
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


def _few_views(rig: Rig, arm: str, known: Mapping[str, Camera]) -> tuple[str, ...]:
    """Return the cameras of an arm whose views are too few for a fit of their own.

    Raises:
        ValueError: one whose lens is not known, or one of a pair of arms; the message names it.
    """
    few = {name: count for name, count in usable_view_counts(rig, known).items() if count < 3}
    for name, count in few.items():
        if name not in known:
            raise ValueError(
                f"camera {name!r}: {count} usable views do not tell its lens: take 3 or more, or "
                f"give the known camera (camera={{{name!r}: ...}}, or --camera FOLDER with a file "
                f"{name}.yaml)"
            )
    for name, count in few.items():
        if is_pair(arm):
            raise ValueError(
                f"camera {name!r}: {count} usable views do not tell where the bases of "
                f"{' and '.join(arms_of(arm))} are: take 3 or more"
            )
    return tuple(few)


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
        most = camera_with_most_views(rig, name, staged)
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
        name: used_view_count(staged[name]) for name, report in reports.items() if report.is_certain
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
