"""Start the joint fit of a rig from one pose for each target, whoever sees it."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxlie import SE3

from .argument_checks import errors_at
from .calibration import Calibration, transform_names
from .cameras import AbstractLens, Camera
from .dataset import Dataset, Rig, is_pair
from .engine import with_lens
from .geometry import PoseLike, host_matrices, host_transforms, mean_pose
from .staged import (
    FewViewsStart,
    StagedFit,
    check_start,
    known_transforms,
    merged_start,
    start_by_target,
)

AnyStart = Calibration | Mapping[str, PoseLike] | None
"""The start of a camera: a calibration, or some of its transforms by name."""

RigStart = Mapping[str, Calibration | Mapping[str, PoseLike]]
"""The starts of some of a rig's cameras, by their names."""

SAME_PLACE = 1e-6
"""Largest difference, m or no unit, of two poses that are meant to be one target's."""


def consistent_starts(
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
            starts[name] = with_given_mount(
                dataclasses.replace(placed, camera=starts[name].camera), given[name]
            )
    return starts


def with_common_pairs(
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
    for name in sorted(starts, key=lambda camera: -used_view_count(staged[camera])):
        if starts[name].mount == "eye_to_hand":
            poses.setdefault(rig.targets[name], starts[name].holder_from_world)
    pairs = [name for name in starts if is_pair(rig.arms[name])]
    for name in sorted(pairs, key=lambda camera: -used_view_count(staged[camera])):
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
        common[name] = with_given_mount(placed, given[name])
    return common


def used_view_count(staged: StagedFit | FewViewsStart) -> int:
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
        return camera_with_most_views(rig, camera, staged)
    first, *others = poses
    for other in others:
        difference = np.abs(host_matrices(poses[first]) - host_matrices(poses[other])).max()
        if difference > SAME_PLACE:
            raise ValueError(
                f"start: cameras {first!r} and {other!r} see one target, {target!r}, but their "
                f"starts place it differently, by {difference:.2g}: give one of them"
            )
    return first


def refuse_unused_places(rig: Rig, few: Sequence[str], start: RigStart) -> None:
    """Raise a ValueError for a target's pose that is given for a camera with few usable views."""
    for name in few:
        given, place = start.get(name), transform_names(rig.cameras[name].mount)[1]
        if isinstance(given, Mapping) and place in given:
            raise ValueError(
                f"camera {name!r}: start: {place}: its few views start from the target that "
                "another camera tells: give it for that camera"
            )


def with_given_mount(calibration: Calibration, start: AnyStart) -> Calibration:
    """Return a calibration with the camera's transform of a start, if it has one."""
    mount = known_transforms(start, calibration.mount)[0]
    return (
        calibration if mount is None else dataclasses.replace(calibration, camera_from_mount=mount)
    )


def checked_starts(
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


def own_paths(rig: Rig, camera: str, paths: Sequence[str]) -> tuple[str, ...]:
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
    mount_from_holder = host_matrices(data.mount_from_holder)
    seen = host_matrices(staged.step2.camera_from_world)[views]
    mounts = seen @ np.linalg.inv(mount_from_holder[views] @ holder_from_world)
    return dataclasses.replace(
        staged.calibration,
        camera_from_mount=mean_pose(host_transforms(mounts)),
        holder_from_world=reference.holder_from_world,
    )


def placed_by_target(
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
    reference = camera_with_most_views(rig, name, staged)
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
    seeing = [name for name in view_counts if rig.see_one_target(name, camera)]
    return max(seeing, key=lambda name: view_counts[name], default=None)


def camera_with_most_views(rig: Rig, camera: str, staged: Mapping[str, StagedFit]) -> str | None:
    """Return which camera with a staged fit tells where a camera's target is, or None."""
    return reference_camera(rig, camera, {name: len(fit.views) for name, fit in staged.items()})
