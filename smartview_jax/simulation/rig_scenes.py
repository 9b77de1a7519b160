"""Simulate a six-axis arm with kinematic errors that carries several cameras."""

import dataclasses

import equinox as eqx
import numpy as np

from ..calibration import Calibration
from ..cameras import OpenCV4
from ..dataset import Rig
from ..geometry import as_se3, host_exponentials, host_matrices, host_transforms
from ..robots import six_axes
from ..runtime.array_namespace import to_device
from .arm_scenes import (
    DISTANCE_RANGE,
    KINEMATIC_ERROR_SIGMA,
    MAX_TILT,
    ArmNoise,
    board_points,
    joints_near_home,
    random_kinematic_errors,
    true_calibration,
)
from .scenes import random_viewpoints, simulate

BASELINE = 0.06
"""Distance between neighbouring cameras, m."""

LENS = (-0.126, 0.0695, 1e-4, 3e-4)
"""Distortion of all cameras: k1, k2, p1 and p2."""


class RigScene(eqx.Module):
    """A simulated rig, together with its true values.

    Attributes:
        rig: the data sets of the cameras, with the robot's reported poses.
        calibrations: the true calibration of each camera.
    """

    rig: Rig = eqx.field(static=True)
    calibrations: dict[str, Calibration]


def six_axis_rig_scene(
    seed: int = 0,
    cameras: int = 4,
    states: int = 8,
    together: bool = False,
    error_scale: float = 1.0,
    *,
    outer_links: bool = False,
    **noise: float,
) -> RigScene:
    """Return views of a flat board by several cameras side by side on the hand of an arm.

    Args:
        seed: seed of numpy's generator; the same seed gives the same scene.
        cameras: number of cameras, called `camera1`, `camera2` and so on.
        states: number of states of the robot in which a camera sees the board.
        together: whether all cameras see the board in the same states; if not, each has its own.
        error_scale: errors of the arm, as multiples of `KINEMATIC_ERROR_SIGMA`.
        outer_links: whether the first and the last link have errors too.
        noise: the fields of `ArmNoise`.

    Raises:
        RuntimeError: the arm does not reach a view.
    """
    sizes = ArmNoise(**noise)
    rng = np.random.default_rng((seed, 4))
    arm, board = six_axes(), board_points()
    error = random_kinematic_errors(arm, rng, error_scale, KINEMATIC_ERROR_SIGMA, outer_links)
    truths = {f"camera{k + 1}": _true_camera(k, cameras, rng) for k in range(cameras)}
    data, reported, actual = {}, None, None
    for number, (name, truth) in enumerate(truths.items()):
        if not together or reported is None:
            # The nominal arm is sent to the wanted views; the real arm misses them by its errors.
            poses = random_viewpoints(rng, states, board.mean(axis=0), DISTANCE_RANGE, MAX_TILT)
            reported = arm.command(joints_near_home(arm, truth.command_for(poses)))
            twists = host_exponentials(-sizes.pose_sigmas * rng.standard_normal((states, 6)))
            actual = as_se3(host_matrices(error.actual_pose(reported)) @ twists)
        assert actual is not None
        seen = simulate(truth, actual, board, 1000 * seed + number, sizes.pixel_noise).data
        first = 0 if together else number * states
        data[name] = dataclasses.replace(
            seen,
            base_from_tool=reported.base_from_tool,
            view_ids=tuple(str(first + k) for k in range(states)),
        )
    with_error = {
        name: dataclasses.replace(truth, robot_error=error) for name, truth in truths.items()
    }
    return RigScene(Rig(data), with_error)


def _true_camera(number: int, count: int, rng: np.random.Generator) -> Calibration:
    """Return the true calibration of one of several cameras side by side, which look inwards."""
    middle = true_calibration()
    offset = number - 0.5 * (count - 1)
    # The axes meet at half a metre.
    turn = np.arctan2(offset * BASELINE, 0.5)
    own_from_middle = host_exponentials(np.array([-offset * BASELINE, 0.0, 0.0, 0.0, turn, 0.0]))
    camera = dataclasses.replace(
        middle.camera,
        alpha_u=to_device(1056.0 * (1.0 + 0.01 * rng.standard_normal())),
        alpha_v=to_device(1056.0 * (1.0 + 0.01 * rng.standard_normal())),
        lens=OpenCV4(*LENS),
    )
    hand = own_from_middle @ host_matrices(middle.camera_from_mount)
    return dataclasses.replace(middle, camera=camera, camera_from_mount=host_transforms(hand))
