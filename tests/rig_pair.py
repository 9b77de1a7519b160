"""Two different cameras of a rig, with errors that they share, and their true places."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5
from smartview_jax.engine import Noise, parameter_names
from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.joint import RigEstimate

LEFT = sv.Camera(800.0, 805.0, 325.0, 236.0, OpenCV5(-0.1, 0.05, 3e-4, -2e-4, 0.0), (640, 480))
RIGHT = sv.Camera(950.0, 945.0, 390.0, 310.0, OpenCV5(0.06, -0.03, -2e-4, 4e-4, 0.01), (800, 600))

NOISE = Noise(0.1, 3e-4, 1e-3)
"""Of the robot's reports; the errors of the cameras are about as large."""

BASE_FROM_WORLD = host_exponentials(np.array([0.4, 0.1, 0.05, 0.1, -0.05, 0.3]))


def placed(x, y=0.0, turn=0.0):
    """A camera's frame from its mount's: shifted, and turned about its vertical axis."""
    return host_exponentials(np.array([x, y, 0.02, 0.0, turn, 0.0]))


def stereo_pair():
    """Two cameras side by side on the hand, which look inwards."""
    return {
        "left": sv.Calibration.eye_in_hand(LEFT, placed(0.05, 0.0, 0.12), BASE_FROM_WORLD),
        "right": sv.Calibration.eye_in_hand(RIGHT, placed(-0.05, 0.01, -0.12), BASE_FROM_WORLD),
    }


def estimate(calibrations, shared=2.0, own=1.0):
    """A joint covariance: hand-eye transforms that err together, and cameras that err alone.

    Args:
        shared: errors that the hand-eye transforms have in common, as multiples of 0.2 mm and
            0.5 mrad.
        own: errors that each has alone, and the place of the target.
    """
    numbers, local = [], {}
    for name, calibration in calibrations.items():
        local[name] = tuple(
            own_name if "_from_world" in own_name else f"{name}.{own_name}"
            for own_name in parameter_names(calibration)
        )
        kept = tuple(f"camera.{k}" for k in ("alpha_u", "alpha_v", "u0", "v0"))
        kept += calibration.transform_names
        numbers += [
            number
            for own_name, number in zip(parameter_names(calibration), local[name], strict=True)
            if own_name.startswith(kept) and number not in numbers
        ]
    factor = np.zeros((len(numbers), 6 + len(numbers)))
    for k, number in enumerate(numbers):
        if ".camera." in number:
            factor[k, 6 + k] = 0.5
            continue
        axis = "xyz".index(number[-1]) + (3 if "rotation" in number else 0)
        size = 5e-4 if "rotation" in number else 2e-4
        factor[k, 6 + k] = own * size
        if "_from_world" not in number:
            factor[k, axis] = shared * size
    covariance = factor @ factor.T
    return RigEstimate(calibrations, covariance, tuple(numbers), local, NOISE)


def drawn_errors(rig, rng, count):
    """True minus calibrated numbers, by name, of rigs that have this covariance."""
    root = np.linalg.cholesky(rig.covariance)
    rows = rng.standard_normal((count, len(root))) @ root.T
    return [dict(zip(rig.parameter_names, row, strict=True)) for row in rows.tolist()]


def true_pose(rig, name, errors, base_from_tool=None, twist=None, frame="world"):
    """The camera's pose with these errors, by SciPy from the meaning of their names.

    Args:
        base_from_tool: as reported; None for a camera next to the arm.
        twist: the robot's error at the tool, `tool_from_base = exp(twist) @ reported`.
    """
    calibration = rig.calibrations[name]
    mount, target = calibration.transform_names
    matrix = _moved(calibration.camera_from_mount, f"{name}.{mount}", errors)
    if base_from_tool is not None:
        # To first order in a twist its exponential is a turn and a shift.
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec(twist[3:]).as_matrix()
        error[:3, 3] = twist[:3]
        matrix = matrix @ error @ np.linalg.inv(base_from_tool)
    return (
        matrix @ _moved(calibration.holder_from_world, target, errors)
        if frame == "world"
        else matrix
    )


def _moved(transform, name, errors):
    """A transform with the errors of its translation and of a turn after it."""
    matrix = host_matrices(transform).copy()
    turn = Rotation.from_rotvec([errors[f"{name}.rotation.{axis}"] for axis in "xyz"])
    matrix[:3, :3] = turn.as_matrix() @ matrix[:3, :3]
    matrix[:3, 3] += [errors[f"{name}.translation.{axis}"] for axis in "xyz"]
    return matrix


def true_camera(rig, name, errors):
    """The camera with these errors."""
    camera = rig.calibrations[name].camera
    numbers = [
        float(getattr(camera, k)) + errors[f"{name}.camera.{k}"]
        for k in ("alpha_u", "alpha_v", "u0", "v0")
    ]
    return sv.Camera(*numbers, camera.lens, camera.image_size)


def seen_by(rig, name, errors, points, *robot, frame="world"):
    """Pixels of points in a picture by a camera with these errors, by OpenCV.

    Args:
        points: m, in the frame of the results.
        robot: arguments of `true_pose`.
    """
    matrix, camera = (
        true_pose(rig, name, errors, *robot, frame=frame),
        true_camera(rig, name, errors),
    )
    lens = np.array([float(x) for x in vars(camera.lens).values()])
    turn = cv2.Rodrigues(matrix[:3, :3])[0]
    return cv2.projectPoints(points, turn, matrix[:3, 3], camera.K, lens)[0][:, 0]


def noise_twist(rng):
    """The robot's error in one state."""
    sizes = np.repeat([NOISE.translation, NOISE.rotation], 3)
    return sizes * rng.standard_normal(6)
