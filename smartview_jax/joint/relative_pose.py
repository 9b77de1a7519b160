"""The pose of one camera of a rig in another's frame, with its covariance."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..calibration import Calibration
from ..geometry import host_adjoints, host_matrices, host_transforms


class RelativePose(NamedTuple):
    """The pose of one camera of a rig in the frame of another.

    Attributes:
        transform: transform from the second camera's frame to the first's.
        covariance: covariance of its translation (m) and of a small rotation (rad) after it, both
            along the axes of the first camera.
    """

    transform: SE3
    covariance: Float[np.ndarray, "6 6"]

    @property
    def std(self) -> Float[np.ndarray, "6"]:
        """The standard deviations of translation (m) and rotation (rad)."""
        return np.sqrt(np.diagonal(self.covariance))


def relative_pose(
    calibrations: Mapping[str, Calibration],
    parameter_names: Sequence[str],
    covariance: Float[np.ndarray, "free free"],
    first: str,
    second: str,
) -> RelativePose:
    """Return the pose of the second camera in the frame of the first.

    Args:
        calibrations: calibration of each camera, by its name.
        parameter_names: names of the free parameters, as of `build_rig`.
        covariance: their covariance.
        first: name of a camera.
        second: name of a camera with the same mount.

    Raises:
        ValueError: no such camera, or cameras that the robot moves against each other.
    """
    for name in (first, second):
        if name not in calibrations:
            raise ValueError(f"expected a camera of {', '.join(calibrations)}, found {name!r}")
    a, b = calibrations[first], calibrations[second]
    if a.mount != b.mount:
        raise ValueError(
            f"relative: camera {first!r} is {a.mount} and {second!r} {b.mount}: their relative "
            "pose changes with the robot's; use their `camera_from_world`"
        )
    matrix = host_matrices(a.camera_from_mount) @ np.linalg.inv(host_matrices(b.camera_from_mount))
    # A small motion (v, w) of A moves A B^-1 as it moves A; one of B by -Ad(A B^-1) (v, w).
    by_first = _twist_by_step(host_matrices(a.camera_from_mount))
    by_second = -host_adjoints(matrix) @ _twist_by_step(host_matrices(b.camera_from_mount))
    names = [
        f"{name}.{c.transform_names[0]}.{part}.{axis}"
        for name, c in ((first, a), (second, b))
        for part in ("translation", "rotation")
        for axis in "xyz"
    ]
    place = {name: k for k, name in enumerate(parameter_names)}
    free = np.array([name in place for name in names])
    indices = [place[name] for name in names if name in place]
    jacobian = np.linalg.solve(_twist_by_step(matrix), np.hstack([by_first, by_second]))
    jacobian = jacobian[:, free]
    known = np.asarray(covariance)[np.ix_(indices, indices)]
    return RelativePose(host_transforms(matrix), jacobian @ known @ jacobian.T)


def _twist_by_step(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Return the twist on the left of a transform per unit of its translation and rotation step."""
    # R -> exp(r) R and t -> t + d is the twist (d + t x r, r).
    result = np.eye(6)
    result[:3, 3:] = np.cross(matrix[:3, 3], np.eye(3)).T
    return result
