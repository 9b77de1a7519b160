"""Check a given start against the answer of the staged fit, and name the usual mistakes.

A drawing has `tool_from_camera` where `camera_from_tool` is asked, millimetres, or the axes of
another convention. A fit that sets out from there may end anywhere, and would blame the robot or
the target's size. The staged fit needs no start: where its answer explains the pictures and the
start does not, the start is wrong. Every mistake is reversed in the start, and the one is named
that brings the points most of the way to where they are seen.

What the robot's motion leaves undetermined is taken from the start, so that nothing contradicts it.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation

from ..calibration import Calibration, transform_names
from ..data_checks import median_reprojection_errors
from ..dataset import Dataset
from ..geometry import PoseLike, as_se3, host_logarithms, host_matrices
from .given_start import known_transforms, merged_start, start_without
from .staged_fit import StagedFit

Matrix = Float[np.ndarray, "4 4"]
"""A homogeneous matrix, m."""

MIN_SHIFT = 0.01
"""The distance of the points from where they are seen, in parts of the picture's longer side, from
which a start is looked at: a start that is nearer is good enough for any fit."""

MAX_ROUGH_TRANSLATION, MAX_ROUGH_ROTATION = 0.15, float(np.deg2rad(30.0))
"""Difference from the answer, m and rad, that a start may have which is measured with a ruler.

One that is further off is doubted also where no known mistake explains it."""

MAX_CORRECTED_RATIO = 0.3
"""Ratio of corrected to given distance below which a mistake counts as an explanation."""

MAX_SAME_POSE = 0.1
"""Difference of two poses that are meant to be the same one: rotation, rad, plus translation over
the distance to the target."""

_OPTICAL_FROM_BODY = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""The camera's frame (x right, y down, z ahead) from a frame with x ahead, y left, z up."""

_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches"}
"""Names of the units in which a start may be where metres are expected, by size in metres."""


class _Reading(NamedTuple):
    """A mistake in a start.

    Attributes:
        words: what was given instead, as a clause.
        pose: the start with the mistake reversed.
    """

    words: str
    pose: Matrix


def start_doubts(
    start: Calibration | Mapping[str, PoseLike] | None,
    fitted: Calibration,
    camera_from_world: SE3,
    inliers: Bool[Array, "views points"] | np.ndarray,
    data: Dataset,
) -> dict[str, str]:
    """Return what is wrong with the transforms of a start: a sentence by the transform's name.

    Args:
        start: a calibration, or transforms by name, as far as they are known.
        fitted: the calibration without the start.
        camera_from_world: from the pictures alone, `(views)`.
        inliers: mask of the points that `fitted` was fitted to.
        data: the data set.
    """

    def distance(start: Mapping[str, SE3]) -> float:
        """Return how far off the points are with a start, px: the median over points and views."""
        calibration = merged_start(fitted, start, data, None)
        errors = median_reprojection_errors(calibration, data.observations, np.asarray(inliers))
        return float(np.median(errors[used]))

    used: np.ndarray = np.any(np.asarray(inliers), axis=1)
    longer_side = max(data.image_size)
    known = known_transforms(start, data.mount)
    doubts: dict[str, str] = {}
    if all(pose is None for pose in known):
        return doubts
    answer = distance({})
    for name, pose in zip(transform_names(data.mount), known, strict=True):
        if pose is None:
            continue
        given = distance({name: pose})
        if not given - answer > MIN_SHIFT * longer_side:
            continue
        as_given = f"the start's {name} does not belong to these data: {_off_by(given, answer)}"
        readings = {
            reading.words: distance({name: as_se3(reading.pose)})
            for reading in _readings(name, host_matrices(pose))
        }
        best = min(readings, key=lambda words: readings[words])
        mixed_up = _mixed_up_pose(host_matrices(pose), camera_from_world, used, data)
        # Points that are not even in the picture are not off by more than it is large.
        explained = MAX_CORRECTED_RATIO * min(given, longer_side)
        if readings[best] < max(explained, 2.0 * answer):
            doubts[name] = f"{as_given}, but {readings[best]:.3g} px {best}"
        elif mixed_up:
            doubts[name] = f"{as_given}: it is {mixed_up}"
        else:
            transform = fitted.camera_from_mount if pose is known[0] else fitted.holder_from_world
            difference = _difference(host_matrices(transform), host_matrices(pose))
            if difference:
                doubts[name] = f"{as_given}. {difference}"
    return doubts


def with_start_doubts(
    staged: StagedFit,
    start: Calibration | Mapping[str, PoseLike] | None,
    data: Dataset,
    used_paths: Sequence[str],
) -> tuple[StagedFit, Calibration | Mapping[str, PoseLike] | None]:
    """Return the staged fit with warnings about the start, and the start without what is doubted.

    Args:
        staged: the staged fit.
        start: the start as it was given.
        data: the data set.
        used_paths: paths of parameters that keep the start, or whose priors may be about it.
    """
    poses = staged.step2.camera_from_world
    doubts = start_doubts(start, staged.calibration, poses, staged.inliers, data)
    if start is None or not doubts:
        return staged, start
    used = {name for name in doubts if any(path.split(".")[0] == name for path in used_paths)}
    warnings = (
        text if name in used else f"{text}; the fit does without it"
        for name, text in doubts.items()
    )
    return (
        dataclasses.replace(staged, warnings=(*staged.warnings, *warnings)),
        start_without(start, doubts.keys() - used, staged.calibration),
    )


def _off_by(given: float, answer: float) -> str:
    """Return how far off the points are with a start and with the answer, in words."""
    if not np.isfinite(given):
        return "most points would be behind the camera"
    return f"the points would be {given:.0f} px off in the median (without it {answer:.2g} px)"


def _difference(answer: Matrix, pose: Matrix) -> str | None:
    """Return how far a start is from the answer, in words; None if it is a rough one."""
    rotation = float(np.linalg.norm(host_logarithms(np.linalg.inv(answer) @ pose)[3:]))
    translation = float(np.linalg.norm(pose[:3, 3] - answer[:3, 3]))
    if translation < MAX_ROUGH_TRANSLATION and rotation < MAX_ROUGH_ROTATION:
        return None
    return (
        f"It is {1e3 * translation:.0f} mm and {np.rad2deg(rotation):.0f} degrees from where the "
        "robot's motion and the pictures put it: give another one, or none"
    )


def _readings(name: str, pose: Matrix) -> Iterator[_Reading]:
    """Yield the mistakes that a start of this name may have, simple ones first."""
    reverse = "_from_".join(reversed(name.split("_from_")))
    inverse = np.linalg.inv(pose)
    exchanged = f"{name} and {reverse} were exchanged"
    yield _Reading(f"if {exchanged}: invert it", inverse)
    for size, unit in _UNITS.items():
        scaled = pose.copy()
        scaled[:3, 3] *= size
        yield _Reading(f"if its lengths are {unit}: metres are expected", scaled)
        yield _Reading(
            f"if {exchanged} and its lengths are {unit}: invert it, in metres",
            np.linalg.inv(scaled),
        )
    turned = pose.copy()
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
    turned[:3, :3] = Rotation.from_euler("ZYX", np.rad2deg(angles)).as_matrix()
    yield _Reading("if its yaw, pitch, roll are radians: degrees are expected", turned)
    if "camera" not in name:
        return
    for words, optical in (
        ("x ahead, y left, z up (camera_link of ROS)", _OPTICAL_FROM_BODY),
        ("x right, y up, z back (OpenGL)", np.diag([1.0, -1.0, -1.0, 1.0])),
    ):
        yield _Reading(
            f"if the camera's axes are {words}: x right, y down, z ahead are expected",
            optical @ pose,
        )
        yield _Reading(
            f"if {exchanged} and the camera's axes are {words}: x right, y down, z ahead are "
            "expected",
            optical @ inverse,
        )


def _mixed_up_pose(
    pose: Matrix, camera_from_world: SE3, used: np.ndarray, data: Dataset
) -> str | None:
    """Return which pose of a view was given as the start, in words; None if it is none."""
    seen = host_matrices(camera_from_world)
    distance = np.linalg.norm(seen[:, :3, 3], axis=1)
    for words, poses in (
        ("the target's pose before the camera", seen),
        ("the camera's pose before the target", np.linalg.inv(seen)),
    ):
        difference = host_logarithms(np.linalg.inv(poses) @ pose)
        score = np.linalg.norm(difference[:, 3:], axis=1)
        score = score + np.linalg.norm(difference[:, :3], axis=1) / distance
        nearest = int(np.argmin(np.where(used, score, np.inf)))
        if score[nearest] < MAX_SAME_POSE:
            return f"{words} in view {data.view_ids[nearest]}"
    return None
