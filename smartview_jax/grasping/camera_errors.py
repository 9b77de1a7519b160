"""Propagate the covariance of a calibration, and the robot's noise, to the camera's pose."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..argument_checks import MAX_LISTED_VIEWS, listed
from ..calibration import Calibration
from ..engine import ROBOT_ERROR, covariance_factor, parameter_names
from ..evaluation import CalibrationEstimate
from ..geometry import host_matrices
from ..modeling import CalibrationUncertainty, RigViews, SeenViews
from ..robots import Command

if TYPE_CHECKING:
    from ..joint import RigEstimate, RigFit

HAND_EYE = "camera_from_tool."
"""The prefix of the names of the hand-eye transform's parameters."""


def camera_covariance(
    calibration: Calibration, estimate: CalibrationEstimate, command: Command
) -> Float[np.ndarray, "n 6 6"]:
    """Return the covariance of the camera's pose at commands `(n)`, translation (m) first.

    It is the covariance of the twist of `camera_from_world`, in the camera's axes: by how much the
    camera misses the wanted pose, due to the calibration's uncertainty and the robot's noise.

    Raises:
        ValueError: the estimate is of another calibration, or leaves something undetermined.
    """
    errors = camera_errors(calibration, estimate, command)
    factor = np.concatenate([errors.shared @ errors.root, errors.unknown, errors.by_noise], axis=2)
    return factor @ factor.swapaxes(1, 2)


class CameraErrors(NamedTuple):
    """The uncertainty of the camera's pose for several commands, as twists in its axes.

    Attributes:
        names: names of the calibration's numbers; of a rig, of the numbers of all its cameras.
        moves_tool: whether each moves the tool, too; the hand-eye transform moves the camera only.
        shared: derivatives by these numbers.
        root: steps of the numbers of one standard deviation each.
        unknown: twists by one standard deviation each of the robot error's coefficients, as far as
            the fitted coefficients do not apply at the command.
        by_noise: twists by one standard deviation each of the robot's noise in this motion.
    """

    names: tuple[str, ...]
    moves_tool: Bool[np.ndarray, "numbers"]
    shared: Float[np.ndarray, "n 6 numbers"]
    root: Float[np.ndarray, "numbers directions"]
    unknown: Float[np.ndarray, "n 6 coefficients"]
    by_noise: Float[np.ndarray, "n 6 noise"]


def camera_errors(
    calibration: Calibration,
    estimate: "CalibrationEstimate | RigFit | RigEstimate",
    command: Command,
) -> CameraErrors:
    """Return the uncertainty of the camera's pose at commands `(n)`.

    Raises:
        ValueError: a command is NaN, since the arm does not reach its pose; or as in
            `camera_covariance`.
    """
    is_reached = np.isfinite(host_matrices(command.base_from_tool)[:, 0, 0])
    if not is_reached.all():
        unreached = [str(1 + k) for k in np.flatnonzero(~is_reached)]
        poses = listed(unreached, MAX_LISTED_VIEWS)
        raise ValueError(
            f"the arm does not reach pose {poses} of {len(is_reached)}: without a command "
            "nothing is known of its error"
        )
    noise = getattr(estimate, "noise", None)
    # A rig has several calibrations.
    if not isinstance(estimate, CalibrationEstimate):
        count = len(command.base_from_tool.wxyz_xyz)
        camera = _camera_of_rig(calibration, estimate)
        rig_views = RigViews(estimate, [camera] * count, states=range(count))
        known = CalibrationUncertainty.of(SeenViews.of(rig_views, command), rig_views, None)
        rig = rig_views.estimate
        assert rig is not None
        local_names = dict(zip(rig.camera_names[camera], parameter_names(calibration), strict=True))
    else:
        known = CalibrationUncertainty.at(calibration, command, estimate, noise)
        rig, local_names = None, {name: name for name in known.shared_names}
    count, size = len(known.view_jacobian), known.shared_count
    names, shared = known.shared_names, known.view_jacobian[:, -6:, :size].copy()
    moves_tool = np.array([not local_names[name].startswith(HAND_EYE) for name in names], bool)
    unknown = np.zeros((count, 6, 0))
    error = calibration.robot_error
    if error is not None and noise is not None:
        # With the correlation r between the coefficients at the command and the fitted ones c, and
        # the prior standard deviation s, the coefficients are r c + sqrt(1 - r^2) s e, with e a
        # standard normal number. Commands near each other have the same e.
        relevance = np.asarray(error.relevance(command))[:, None, None]
        sizes = [size for _, size in error.field.groups]
        by_coefficient = np.repeat(np.asarray(noise.field, dtype=float), sizes)
        prior = dict(zip(error.field.names, by_coefficient, strict=True))
        prefix = f"{ROBOT_ERROR}."
        local = [local_names[name] for name in names]
        columns = np.flatnonzero([name.startswith(prefix) for name in local])
        std = np.array([prior[local[k].removeprefix(prefix)] for k in columns])
        unknown = np.sqrt(1.0 - relevance**2) * shared[:, :, columns] * std
        shared[:, :, columns] *= relevance
    motion_noise = np.zeros((count, 6, 6 if known.view_jacobian.shape[2] > size else 0))
    for k in range(count if motion_noise.shape[2] else 0):
        place = slice(size + 6 * k, size + 6 * k + 6)
        motion_noise[k] = known.view_jacobian[k, -6:, place] @ covariance_factor(
            known.covariance[place, place]
        )
    covariance = known.covariance[:size, :size]
    if rig is not None:
        # Other cameras' numbers do not move this camera, but the pose of an object that they saw.
        others = [k for k, name in enumerate(rig.parameter_names) if name not in names]
        rows = [rig.parameter_names.index(name) for name in names] + others
        names = tuple(rig.parameter_names[k] for k in rows)
        covariance = rig.covariance[np.ix_(rows, rows)]
        shared = np.concatenate([shared, np.zeros((count, 6, len(others)))], axis=2)
        moves_tool = np.concatenate([moves_tool, np.zeros(len(others), bool)])
    root = covariance_factor(covariance)
    return CameraErrors(names, moves_tool, shared, root, unknown, motion_noise)


def _camera_of_rig(calibration: Calibration, estimate: "RigFit | RigEstimate") -> str:
    """Return the name of the rig's camera that has a calibration."""
    for name, known in estimate.calibrations.items():
        if known is calibration:
            return name
    raise ValueError(
        "estimate: the calibration is of none of the rig's cameras, "
        f"{', '.join(estimate.calibrations)}; give one of the fit's own calibrations"
    )
