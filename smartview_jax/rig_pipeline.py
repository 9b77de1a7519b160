"""Calibrate a rig: each camera by the staged pipeline, then all of them together."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Unpack

import numpy as np

from .argument_checks import require_instance
from .calibration import Calibration, host_mount_from_holder, transform_names
from .cameras import AbstractLens, Camera
from .dataset import Dataset, Rig
from .geometry import PoseLike, host_matrices, host_transforms, mean_pose
from .joint import JointOptions, RigFit, fit_rig, remove_gross_errors
from .runtime.double_precision import require_double_precision
from .staged import StagedFit, fit_staged

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
    target, such as one that saw it in a single orientation.

    Args:
        rig: data sets of the cameras; each camera has at least three views.
        lens: lens model of all cameras.
        cameras: known cameras by name, which are held.
        progress: called with a line of text for each stage.
        joint_options: options of `fit_rig`, by keyword.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: a camera that cannot be calibrated; the message names it. An option of
            `fit_joint` that a rig does not have.
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
    staged, starts = {}, {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        of_arm = _staged_fits(part, lens, known, report)
        staged, starts = staged | of_arm, starts | _consistent_starts(part, of_arm)
    used, rejected = {}, []
    for name, data in rig.cameras.items():
        inliers = data.with_visible(np.asarray(data.visible) & np.asarray(staged[name].inliers))
        used[name], outliers = remove_gross_errors(inliers, starts[name], (), None, None)
        rejected += [(name, entry) for entry in (*staged[name].rejected, *outliers)]
    fixed = (*joint_options.get("fixed", ()), *(f"{name}.camera" for name in known))
    fit = fit_rig(
        rig.with_cameras(used),
        starts,
        progress=progress,
        rejected=rejected,
        **{**joint_options, "fixed": fixed},
    )
    return dataclasses.replace(fit, warnings=_warnings(staged, fit))


def _staged_fits(
    rig: Rig,
    lens: str | AbstractLens,
    known: Mapping[str, Camera],
    report: Callable[[str], None],
) -> dict[str, StagedFit]:
    """Return the staged fit of each camera alone, or from the target's place that others tell.

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

    for name in rig.cameras:
        fit(name, None)
    for name in list(errors):
        others = [other for other in staged if rig.targets[other] == rig.targets[name]]
        if others:
            most = max(others, key=lambda other: len(staged[other].views))
            report(f"{name}: again, from the place of its target that {most} tells")
            place = staged[most].calibration.holder_from_world
            fit(name, {transform_names(rig.cameras[name].mount)[1]: place})
        if name not in staged:
            raise ValueError(f"camera {name!r}: {errors[name]}") from errors[name]
    return {name: staged[name] for name in rig.cameras}


def _consistent_starts(rig: Rig, staged: Mapping[str, StagedFit]) -> dict[str, Calibration]:
    """Return the calibrations of the staged fits, with one pose for each target."""
    starts = {name: fit.calibration for name, fit in staged.items()}
    for target in set(rig.targets.values()):
        seeing = [name for name in rig.cameras if rig.targets[name] == target]
        first = max(seeing, key=lambda name: len(staged[name].views))
        for name in seeing:
            if name != first:
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


def _warnings(staged: Mapping[str, StagedFit], fit: RigFit) -> tuple[str, ...]:
    """Return the doubts of the staged fits, with the camera's name, and of the joint fit."""
    of_cameras = [f"{name}: {text}" for name, one in staged.items() for text in one.warnings]
    return (*of_cameras, *fit.warnings)
