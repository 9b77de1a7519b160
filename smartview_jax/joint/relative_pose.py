"""The pose of one camera or one arm's base of a rig in another's frame, with its covariance."""

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import Calibration
from ..engine import base_path, step_names, twist_by_step
from ..files import finite_or_null, read_yaml
from ..geometry import (
    host_adjoints,
    host_matrices,
    host_transforms,
    transform_from_dict,
    transform_to_dict,
)
from ..variance import SmallSampleCorrection, joined_corrections
from .joint_fit import half_width
from .open_directions import OpenDirections, any_changed

_T = TypeVar("_T")


class RelativePose(NamedTuple):
    """The pose of one camera, or of one arm's base, in the frame of another.

    Attributes:
        transform: transform from the second one's frame to the first's.
        covariance: covariance of its translation (m) and of a small rotation (rad) after it, both
            along the axes of the first. A number that nothing determines has an infinite variance.
        degrees_of_freedom: degrees of freedom of these six numbers' standard deviations; infinite
            where the noise was given.

    For example, with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> both = sv.fit_rig(rig, {"left": truth, "right": truth}, noise=noise)
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     both.relative("left", "right").save(f"{folder}/stereo.yaml")
        ...     stereo = sv.RelativePose.load(f"{folder}/stereo.yaml")
        >>> print(f"{1e3 * stereo.std[2]:.1f} mm along the optical axis")
        0.9 mm along the optical axis
    """

    transform: SE3
    covariance: Float[np.ndarray, "6 6"]
    degrees_of_freedom: tuple[float, ...] = (np.inf,) * 6

    @property
    def std(self) -> Float[np.ndarray, "6"]:
        """The standard deviations of translation (m) and rotation (rad)."""
        return np.sqrt(np.diagonal(self.covariance))

    def half_widths(self, level: float = 0.95) -> Float[np.ndarray, "6"]:
        """Return the half widths of confidence intervals of translation (m) and rotation (rad).

        Args:
            level: probability that an interval contains the true value.
        """
        both = zip(self.std, self.degrees_of_freedom, strict=True)
        return np.array([half_width(std, freedom, level) for std, freedom in both])

    def save(self, path: str | os.PathLike[str], run: str | None = None) -> None:
        """Write a file that `load` reads: YAML, or JSON where the name ends in `.json`.

        Args:
            path: of the file, which is written completely or not at all.
            run: name of the run that produced this; None without one.

        Raises:
            ValueError: a value with which the file could not be read back.
        """
        # The validation library is imported only where files are read or written.
        from ..schemas.calibrated_rig import RELATIVE_POSE_SCHEMA
        from ..schemas.validation import write_validated

        content = {
            "smartview_relative_pose": 1,
            **({} if run is None else {"run": run}),
            "first_from_second": transform_to_dict(self.transform),
            "covariance": [list(map(finite_or_null, row)) for row in self.covariance],
            "degrees_of_freedom": list(map(finite_or_null, self.degrees_of_freedom)),
            "end": "smartview_relative_pose",
        }
        write_validated(path, content, RELATIVE_POSE_SCHEMA)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "RelativePose":
        """Read a file that `save` wrote.

        Raises:
            FileNotFoundError: the file is missing.
            ValueError: a wrong entry; the message names it and the file.
        """
        from ..schemas.calibrated_rig import RELATIVE_POSE_SCHEMA
        from ..schemas.validation import validate_content

        content = validate_content(read_yaml(path), RELATIVE_POSE_SCHEMA, path)
        pose = transform_from_dict(f"{path}: pose", content.first_from_second.model_dump())
        covariance = [_with_infinity(row) for row in content.covariance]
        freedom = _with_infinity(content.degrees_of_freedom or [None] * 6)
        return cls(pose, np.array(covariance), tuple(freedom))


def _with_infinity(numbers: Iterable[float | None]) -> list[float]:
    """Return the numbers of a file, in which None stands for infinity."""
    return [np.inf if number is None else number for number in numbers]


class RigUncertainty(NamedTuple):
    """The uncertainty of the common parameters of a rig.

    Attributes:
        parameter_names: names of the free parameters, as of `build_rig` or `build_arms`.
        covariance: their covariance.
        correction: what estimated noise adds to the covariance; None for given noise.
        undetermined: combinations of parameters that nothing determines.
    """

    parameter_names: Sequence[str]
    covariance: Float[np.ndarray, "free free"]
    correction: SmallSampleCorrection | None = None
    undetermined: Sequence[OpenDirections] = ()


def relative_pose(
    calibrations: Mapping[str, Calibration], known: RigUncertainty, first: str, second: str
) -> RelativePose:
    """Return the pose of the second camera in the frame of the first.

    Args:
        calibrations: calibration of each camera, by its name.
        known: their uncertainty.
        first: name of a camera.
        second: name of a camera with the same mount.

    Raises:
        ValueError: no such camera, or cameras that the robot moves against each other.
    """
    a, b = _both("a camera", calibrations, first, second)
    if a.transform_names[0] != b.transform_names[0]:
        raise ValueError(
            f"relative: camera {first!r} is {a.mount} and {second!r} {b.mount}: their relative "
            "pose changes with the robot's; use their `camera_from_world`"
        )
    first_pose, second_pose = (
        _Pose(host_matrices(c.camera_from_mount), step_names(f"{name}.{c.transform_names[0]}"))
        for name, c in ((first, a), (second, b))
    )
    matrix = first_pose.matrix @ np.linalg.inv(second_pose.matrix)
    # A small motion (v, w) of A moves A B^-1 as it moves A; one of B by -Ad(A B^-1) (v, w).
    twists = [(first_pose, np.eye(6)), (second_pose, -host_adjoints(matrix))]
    return _with_covariance(matrix, twists, known)


def relative_base(
    bases: Mapping[str, SE3], known: RigUncertainty, first: str, second: str
) -> RelativePose:
    """Return the pose of the second arm's base in the base of the first.

    Args:
        bases: transform from each arm's base to the base of the first of all arms.
        known: their uncertainty.
        first, second: names of arms.

    Raises:
        ValueError: no such arm.
    """
    reference = next(iter(bases))
    first_pose, second_pose = (
        _Pose(host_matrices(base), step_names(base_path(reference, name)))
        for name, base in zip((first, second), _both("an arm", bases, first, second), strict=True)
    )
    first_inverse = np.linalg.inv(first_pose.matrix)
    # A small motion of B moves A^-1 B by Ad(A^-1) (v, w), and one of A by as much the other way.
    by_motion = host_adjoints(first_inverse)
    twists = [(first_pose, -by_motion), (second_pose, by_motion)]
    matrix = first_inverse @ second_pose.matrix
    return _with_covariance(matrix, twists, known)


def _both(kind: str, by_name: Mapping[str, _T], first: str, second: str) -> tuple[_T, _T]:
    """Return what two names stand for; a ValueError names one that is unknown."""
    for name in (first, second):
        if name not in by_name:
            raise ValueError(f"expected {kind} of {', '.join(by_name)}, found {name!r}")
    return by_name[first], by_name[second]


class _Pose(NamedTuple):
    """A transform, and the names of its parameters."""

    matrix: Float[np.ndarray, "4 4"]
    names: tuple[str, ...]


def _with_covariance(
    matrix: Float[np.ndarray, "4 4"],
    twists: Sequence[tuple[_Pose, Float[np.ndarray, "6 6"]]],
    known: RigUncertainty,
) -> RelativePose:
    """Return a transform with its covariance by the parameters of the transforms that make it up.

    `twists` are its motions on the left by the motion on the left of each of these transforms.
    """
    names = [name for pose, _ in twists for name in pose.names]
    by_steps = [by_motion @ twist_by_step(pose.matrix) for pose, by_motion in twists]
    place = {name: k for k, name in enumerate(known.parameter_names)}
    free = np.array([name in place for name in names])
    indices = [place[name] for name in names if name in place]
    by_all = np.linalg.solve(twist_by_step(matrix), np.hstack(by_steps))
    is_open, jacobian = any_changed(known.undetermined, names, by_all), by_all[:, free]
    of_pose = jacobian @ np.asarray(known.covariance)[np.ix_(indices, indices)] @ jacobian.T
    if known.correction is None:
        return RelativePose(host_transforms(matrix), _with_infinite(of_pose, is_open))
    part = known.correction.subset(np.array(indices, dtype=int))
    added = jacobian @ part.added_covariance @ jacobian.T
    joined = joined_corrections([(part, jacobian)], np.diagonal(of_pose - added))
    freedom = tuple(np.where(is_open, np.inf, joined.degrees_of_freedom).tolist())
    return RelativePose(host_transforms(matrix), _with_infinite(of_pose, is_open), freedom)


def _with_infinite(
    covariance: Float[np.ndarray, "6 6"], is_open: Bool[np.ndarray, "6"]
) -> Float[np.ndarray, "6 6"]:
    """Return a covariance with infinite variances of some numbers, uncorrelated with the others."""
    either = is_open[:, None] | is_open[None, :]
    return np.where(either, np.diag(np.where(is_open, np.inf, 0.0)), covariance)
