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
from jaxtyping import Float

from ..engine import covariance_factor
from ..geometry import host_adjoints, host_matrices
from ..robots import Command, Gripper
from .camera_errors import camera_errors
from .localized import LocalizedObject, checked_object
from .scene import GraspScene


class GripperErrors(NamedTuple):
    """The uncertainty of the gripper's pose for one command.

    Attributes:
        shared: derivatives of tau by standard deviations of the calibration's numbers.
        by_noise: derivatives of tau by standard deviations of the robot's noise in this motion.
        root: the numbers' steps of one standard deviation each; its rows belong to `shared`.
        names: names of the calibration's numbers, one for each row of `root`; of a rig, of the
            numbers of all its cameras.
    """

    shared: Float[np.ndarray, "6 directions"]
    by_noise: Float[np.ndarray, "6 noise"]
    root: Float[np.ndarray, "numbers directions"]
    names: tuple[str, ...]


def gripper_errors(
    scene: GraspScene, gripper: Gripper, command: Command
) -> tuple[GripperErrors, ...]:
    """Return the uncertainty of the gripper's pose at commands `(n)`."""
    count = len(command.base_from_tool.wxyz_xyz)
    if scene.estimate is None:
        nothing = GripperErrors(np.zeros((6, 0)), np.zeros((6, 0)), np.zeros((0, 0)), ())
        # With an exact calibration only the object's own covariance remains.
        return (nothing,) * count
    # The calibration's uncertainty describes the twist of the camera at this command.
    errors = camera_errors(scene.calibration, scene.estimate, command)
    camera_from_gripper = (
        host_matrices(scene.calibration.camera_from_tool) @ gripper.tool_from_gripper
    )
    # exp(twist) camera_from_world, with the twist moved to the gripper's side of the transform.
    to_gripper = host_adjoints(np.linalg.inv(camera_from_gripper))
    # Extrapolation errors of the robot's error are no numbers of the calibration.
    root = np.pad(errors.root, ((0, 0), (0, errors.unknown.shape[2])))
    by_numbers = (errors.shared * errors.moves_tool) @ errors.root
    shared = to_gripper @ np.concatenate([by_numbers, errors.unknown], axis=2)
    by_noise = to_gripper @ errors.by_noise
    return tuple(GripperErrors(shared[k], by_noise[k], root, errors.names) for k in range(count))


def error_covariance(
    localized: LocalizedObject, gripper_from_object: Float[np.ndarray, "4 4"], errors: GripperErrors
) -> Float[np.ndarray, "12 12"]:
    """Return the joint covariance of eta and tau, in this order, for one grasp."""
    _, covariance = checked_object(localized)
    to_gripper = host_adjoints(gripper_from_object)
    jacobian = localized.calibration_jacobian
    shared = np.zeros_like(errors.shared)
    if jacobian is not None and len(errors.root):
        names = localized.calibration_names
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
        (errors.by_noise, errors.by_noise),
    ]
    root = np.concatenate([np.concatenate(pair) for pair in blocks], axis=1)
    return root @ root.T
