"""Propagate the covariances of an object's pose and of the calibration to the gripper.

With world_from_object exp(xi) the true pose of the object, and exp(tau) gripper_from_world the true
pose of the world seen from where the gripper really goes, the object is displaced at the gripper by

    eta = tau + Ad(gripper_from_object) xi

Both xi and tau follow from the numbers of the calibration. A localisation that states its
derivatives by them (`calibration_jacobian`, by the numbers of `CalibrationUncertainty`) has the
common part cancel as it does in reality; of any other, xi and tau are taken as independent.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..engine import covariance_factor
from ..geometry import host_adjoints, host_matrices
from ..modeling import CalibrationUncertainty, SeenViews
from ..robots import Command, Gripper
from .localized import LocalizedObject, checked_object
from .scene import GraspScene

HAND_EYE = "camera_from_tool."
"""The beginning of the names of the hand-eye transform's parameters."""


class GripperErrors(NamedTuple):
    """The uncertainty of where the gripper goes for one command.

    Attributes:
        shared: derivatives of tau by standard deviations of the calibration's numbers.
        own: derivatives of tau by standard deviations of the robot's noise in this motion.
        root: the numbers' steps of one standard deviation each; its rows belong to `shared`.
    """

    shared: Float[np.ndarray, "6 directions"]
    own: Float[np.ndarray, "6 noise"]
    root: Float[np.ndarray, "numbers directions"]


def gripper_errors(
    scene: GraspScene, gripper: Gripper, command: Command
) -> tuple[GripperErrors, ...]:
    """Return what is uncertain about the gripper's pose at commands `(n)`.

    Raises:
        ValueError: the scene's estimate is of another calibration, or leaves something open.
    """
    count = len(command.base_from_tool.wxyz_xyz)
    if scene.estimate is None:
        nothing = GripperErrors(np.zeros((6, 0)), np.zeros((6, 0)), np.zeros((0, 0)))
        # An exact calibration: the object's own covariance is all there is.
        return (nothing,) * count
    # The twist of the camera at this command is what the calibration's uncertainty describes.
    views = SeenViews.of(scene.calibration, command)
    noise = getattr(scene.estimate, "noise", None)
    known = CalibrationUncertainty.of(views, scene.calibration, scene.estimate, noise)
    shared = known.shared_count
    # The hand-eye transform moves the camera on the tool, not the tool itself.
    moves_tool = np.array([not name.startswith(HAND_EYE) for name in known.names[:shared]], bool)
    camera_from_gripper = (
        host_matrices(scene.calibration.camera_from_tool) @ gripper.tool_from_gripper
    )
    # exp(twist) camera_from_world, with the twist moved to the gripper's side of the transform.
    to_gripper = host_adjoints(np.linalg.inv(camera_from_gripper))
    root = covariance_factor(known.covariance[:shared, :shared])
    found = []
    for k in range(count):
        twist = to_gripper @ known.view_jacobian[k, -6:]
        own = slice(shared + 6 * k, shared + 6 * k + 6)
        noise_root = covariance_factor(known.covariance[own, own])
        found.append(
            GripperErrors((twist[:, :shared] * moves_tool) @ root, twist[:, own] @ noise_root, root)
        )
    return tuple(found)


def error_covariance(
    found: LocalizedObject, gripper_from_object: Float[np.ndarray, "4 4"], errors: GripperErrors
) -> Float[np.ndarray, "12 12"]:
    """Return the covariance of eta and tau, in this order, of one grasp.

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
        if jacobian.shape != (6, len(errors.root)):
            raise ValueError(
                f"calibration_jacobian: expected (6, {len(errors.root)}), one column for each "
                f"number of the scene's calibration, found {jacobian.shape}"
            )
        shared = jacobian @ errors.root
        # What is left of the object's covariance is not the calibration's; rounding may leave
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
