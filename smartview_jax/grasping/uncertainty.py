"""Propagate the covariances of an object's pose and of the calibration to the gripper.

With world_from_object exp(xi) the true pose of the object, and exp(tau) gripper_from_world the true
pose of the world in the frame to which the gripper really moves, the object is displaced in the
gripper's frame by

    eta = tau + Ad(gripper_from_object) xi

Both xi and tau depend on the numbers of the calibration. If a localisation gives its derivatives by
them (`calibration_jacobian`, by the numbers of `CalibrationUncertainty`), the common part cancels,
as in reality; otherwise xi and tau are taken as independent.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration import Calibration
from ..engine import ROBOT_ERROR, covariance_factor, parameter_names
from ..evaluation import CalibrationEstimate
from ..geometry import host_adjoints, host_matrices
from ..joint import RigEstimate, RigFit
from ..modeling import CalibrationUncertainty, RigViews, SeenViews
from ..robots import Command, Gripper
from .localized import LocalizedObject, checked_object
from .scene import GraspScene

HAND_EYE = "camera_from_tool."
"""The prefix of the names of the hand-eye transform's parameters."""


class GripperErrors(NamedTuple):
    """The uncertainty of the gripper's pose for one command.

    Attributes:
        shared: derivatives of tau by standard deviations of the calibration's numbers.
        own: derivatives of tau by standard deviations of the robot's noise in this motion.
        root: the numbers' steps of one standard deviation each; its rows belong to `shared`.
        names: names of the calibration's numbers, one for each row of `root`; of a rig, of the
            numbers of all its cameras.
    """

    shared: Float[np.ndarray, "6 directions"]
    own: Float[np.ndarray, "6 noise"]
    root: Float[np.ndarray, "numbers directions"]
    names: tuple[str, ...]


def gripper_errors(
    scene: GraspScene, gripper: Gripper, command: Command
) -> tuple[GripperErrors, ...]:
    """Return the uncertainty of the gripper's pose at commands `(n)`.

    Raises:
        ValueError: the scene's estimate is of another calibration, or leaves numbers undetermined.
    """
    count = len(command.base_from_tool.wxyz_xyz)
    if scene.estimate is None:
        nothing = GripperErrors(np.zeros((6, 0)), np.zeros((6, 0)), np.zeros((0, 0)), ())
        # With an exact calibration only the object's own covariance remains.
        return (nothing,) * count
    # The calibration's uncertainty describes the twist of the camera at this command.
    errors = _camera_errors(scene.calibration, scene.estimate, command)
    camera_from_gripper = (
        host_matrices(scene.calibration.camera_from_tool) @ gripper.tool_from_gripper
    )
    # exp(twist) camera_from_world, with the twist moved to the gripper's side of the transform.
    to_gripper = host_adjoints(np.linalg.inv(camera_from_gripper))
    # Extrapolation errors of the robot's error are no numbers of the calibration.
    root = np.pad(errors.root, ((0, 0), (0, errors.unknown.shape[2])))
    by_numbers = (errors.shared * errors.moves_tool) @ errors.root
    shared = to_gripper @ np.concatenate([by_numbers, errors.unknown], axis=2)
    own = to_gripper @ errors.own
    return tuple(GripperErrors(shared[k], own[k], root, errors.names) for k in range(count))


def camera_covariance(
    calibration: Calibration, estimate: CalibrationEstimate, command: Command
) -> Float[np.ndarray, "n 6 6"]:
    """Return the covariance of the camera's pose at commands `(n)`, translation (m) first.

    It is the covariance of the twist of `camera_from_world`, in the camera's axes: by how much the
    camera misses the wanted pose, due to the calibration's uncertainty and the robot's noise.

    Raises:
        ValueError: the estimate is of another calibration, or leaves something undetermined.
    """
    errors = _camera_errors(calibration, estimate, command)
    factor = np.concatenate([errors.shared @ errors.root, errors.unknown, errors.own], axis=2)
    return factor @ factor.swapaxes(1, 2)


class _CameraErrors(NamedTuple):
    """The uncertainty of the camera's pose for several commands, as twists in its axes.

    Attributes:
        names: names of the calibration's numbers; of a rig, of the numbers of all its cameras.
        moves_tool: whether each moves the tool, too; the hand-eye transform moves the camera only.
        shared: derivatives by these numbers.
        root: steps of the numbers of one standard deviation each.
        unknown: twists by one standard deviation each of the robot error's coefficients, as far as
            the fitted coefficients do not apply at the command.
        own: twists by one standard deviation each of the robot's noise in this motion.
    """

    names: tuple[str, ...]
    moves_tool: Bool[np.ndarray, "numbers"]
    shared: Float[np.ndarray, "n 6 numbers"]
    root: Float[np.ndarray, "numbers directions"]
    unknown: Float[np.ndarray, "n 6 coefficients"]
    own: Float[np.ndarray, "n 6 noise"]


def _camera_errors(
    calibration: Calibration,
    estimate: CalibrationEstimate | RigFit | RigEstimate,
    command: Command,
) -> _CameraErrors:
    """Return the uncertainty of the camera's pose at commands `(n)`."""
    noise = getattr(estimate, "noise", None)
    if isinstance(estimate, RigFit | RigEstimate):
        count = len(command.base_from_tool.wxyz_xyz)
        camera = _camera_of_rig(calibration, estimate)
        rig_views = RigViews(estimate, [camera] * count, states=range(count))
        known = CalibrationUncertainty.of(SeenViews.of(rig_views, command), rig_views, None)
        rig = rig_views.estimate
        assert rig is not None
        local_names = dict(zip(rig.camera_names[camera], parameter_names(calibration), strict=True))
    else:
        views = SeenViews.of(calibration, command)
        known = CalibrationUncertainty.of(views, calibration, estimate, noise)
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
    return _CameraErrors(names, moves_tool, shared, root, unknown, motion_noise)


def _camera_of_rig(calibration: Calibration, estimate: RigFit | RigEstimate) -> str:
    """Return the name of the rig's camera that has a calibration.

    Raises:
        ValueError: no camera of the rig has it.
    """
    for name, known in estimate.calibrations.items():
        if known is calibration:
            return name
    raise ValueError(
        "estimate: the calibration is of none of the rig's cameras, "
        f"{', '.join(estimate.calibrations)}; give one of the fit's own calibrations"
    )


def error_covariance(
    found: LocalizedObject, gripper_from_object: Float[np.ndarray, "4 4"], errors: GripperErrors
) -> Float[np.ndarray, "12 12"]:
    """Return the joint covariance of eta and tau, in this order, for one grasp.

    Args:
        found: the object.
        gripper_from_object: its pose in the gripper's frame.
        errors: of the gripper's pose.
    """
    _, covariance = checked_object(found)
    to_gripper = host_adjoints(gripper_from_object)
    jacobian = found.calibration_jacobian
    shared = np.zeros_like(errors.shared)
    if jacobian is not None and len(errors.root):
        names = found.calibration_names
        if jacobian.shape != (6, len(names)):
            raise ValueError(
                f"calibration_jacobian: expected (6, {len(names)}), one column for each of "
                f"calibration_names, found {jacobian.shape}"
            )
        if unknown := [name for name in names if name not in errors.names]:
            raise ValueError(
                f"calibration_names: the scene's estimate has no number {unknown[0]!r}; where "
                "several cameras saw the object, give the scene the fit of the rig"
            )
        shared = jacobian @ errors.root[[errors.names.index(name) for name in names]]
        # The rest of the object's covariance is not due to the calibration; rounding may leave
        # slightly negative eigenvalues.
        covariance = covariance - shared @ shared.T
    object_root = covariance_factor(covariance)
    blocks = [
        (to_gripper @ object_root, np.zeros_like(object_root)),
        (to_gripper @ shared + errors.shared, errors.shared),
        (errors.own, errors.own),
    ]
    root = np.concatenate([np.concatenate(pair) for pair in blocks], axis=1)
    return root @ root.T
