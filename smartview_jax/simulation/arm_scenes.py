"""Simulate a six-axis arm with kinematic errors that views a warped board.

The controller reports the forward kinematics of the nominal arm. The real arm has other joint
zeros, link lengths and link twists, the lens has more distortion than its four fitted coefficients
describe, and the board is not flat. As in real set-ups, no estimator models all of it.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..cameras import Camera, OpenCV5
from ..dataset import Dataset
from ..geometry import as_se3, host_exponentials, host_matrices
from ..robot_errors import DHErrors, RobotError
from ..robots import SerialArm, six_axes, solve_joints_iteratively
from ..runtime.array_namespace import to_device
from ..runtime.padding import over_padded_views
from .scenes import calibration_of, random_viewpoints, simulate

KINEMATIC_ERROR_SIGMA = {
    "joint_offset": float(np.deg2rad(0.05)),
    "link_length": 3e-4,
    "link_twist": float(np.deg2rad(0.03)),
}
"""Standard deviations of the arm's errors, rad and m, by the groups of `DHErrors`."""

PERTURBED_LINKS = slice(1, 5)
"""Indices of the joints and links with errors: 2 to 5, counted from one.

Errors of the first and the last are equivalent to displacements of base and tool.
"""

HOME_JOINTS = np.deg2rad([0.0, -10.0, 40.0, 0.0, 60.0, 0.0])
"""Joint angles, rad, at which the tool is above the table and points down."""

DISTANCE_RANGE = (0.425, 0.625)
"""Smallest and largest distance from the camera to the board, m."""
MAX_TILT = float(np.deg2rad(30.0))
"""Largest angle between the viewing direction and the vertical, rad."""
WARP_RANGE = (1e-4, 1.5e-4)
"""Smallest and largest deviation of the board from its plane, m."""


class ArmNoise(NamedTuple):
    """The random noise of an arm's scene, in addition to the arm's own errors.

    Attributes:
        pixel_noise: standard deviation of `u` and of `v`, px.
        translation_noise, rotation_noise: as in `simulate`; m and rad.
    """

    pixel_noise: float = 0.05
    translation_noise: float = 2e-5
    rotation_noise: float = float(np.deg2rad(0.003))

    @property
    def pose_sigmas(self) -> Float[np.ndarray, "6"]:
        """The standard deviations of a pose's error: translation, then rotation."""
        return np.repeat([self.translation_noise, self.rotation_noise], 3)


class ArmScene(eqx.Module):
    """A simulated data set of an arm, together with its true values.

    Attributes:
        data: the data set of the experiment, with the robot's reported poses as commands.
        held_out: held-out views, also with reported poses; their pixels and the arm's poses have no
            random noise.
        calibration: the true calibration, including the arm's error.
        joints: joint readings in the views of `data`, rad.
        held_out_joints: joint readings in the views of `held_out`, rad.
    """

    data: Dataset
    held_out: Dataset
    calibration: Calibration
    joints: Float[Array, "views joints"]
    held_out_joints: Float[Array, "held_out_views joints"]

    @property
    def with_joint_readings(self) -> "ArmScene":
        """The same scene, with joint readings in its data sets."""
        arm = six_axes()
        data = self.data.with_joints(self.joints, arm)
        held_out = self.held_out.with_joints(self.held_out_joints, arm)
        return dataclasses.replace(self, data=data, held_out=held_out)


def six_axis_scene(
    seed: int = 0,
    views: int = 25,
    held_out_views: int = 40,
    error_scale: float = 1.0,
    *,
    warp_range: tuple[float, float] = WARP_RANGE,
    error_sigma: Mapping[str, float] = KINEMATIC_ERROR_SIGMA,
    arm_error: RobotError | None = None,
    **noise: float,
) -> ArmScene:
    """Return random views of a board of 12 x 9 points, 30 mm apart, by a 1056 px camera on an arm.

    Args:
        error_scale: errors of the arm, as multiples of `error_sigma`.
        warp_range: smallest and largest deviation of the board from its plane, m.
        error_sigma: standard deviations of the arm's errors, by the groups of `DHErrors`.
        arm_error: the arm's errors, of the arm `robots.six_axes`; by default they are random.
        noise: the fields of `ArmNoise`.

    Raises:
        RuntimeError: the arm does not reach a view.
    """
    sizes = ArmNoise(**noise)
    rng = np.random.default_rng((seed, 3))
    arm, board = six_axes(), board_points()
    # The random numbers are drawn in any case, so that a seed gives the same views.
    drawn = random_kinematic_errors(arm, rng, error_scale, error_sigma)
    error = drawn if arm_error is None else arm_error
    truth = dataclasses.replace(true_calibration(), robot_error=error)
    warped_board = board + _random_warp(board, rng.uniform(*warp_range), rng)
    camera_poses = random_viewpoints(
        rng, views + held_out_views, board.mean(axis=0), DISTANCE_RANGE, MAX_TILT
    )
    # The nominal arm is sent to the wanted views; the real arm misses them by its errors.
    joints = joints_near_home(arm, truth.command_for(camera_poses, corrected=False))

    # Random noise applies to the views of the data only: held-out views test the repeatable part.
    #     actual_poses = error.actual_pose(command) exp(noise)^-1
    with_noise = np.arange(views + held_out_views)[:, None] < views
    noise_by_view = np.where(with_noise, sizes.pose_sigmas, 0.0)
    twists = host_exponentials(-noise_by_view * rng.standard_normal(noise_by_view.shape))
    command = arm.command(joints)
    actual_poses = as_se3(host_matrices(error.actual_pose(command)) @ twists)
    datasets: list[Dataset] = []
    joints_by_part: list[Float[Array, "_ joints"]] = []
    for view_slice, sigma in ((slice(None, views), sizes.pixel_noise), (slice(views, None), 0.0)):
        part = jax.tree.map(lambda x, chosen=view_slice: to_device(np.asarray(x)[chosen]), command)
        actual_part = SE3(to_device(np.asarray(actual_poses.wxyz_xyz)[view_slice]))
        simulated = simulate(truth.uncorrected, actual_part, warped_board, seed, sigma).data
        # The pixels show the warped board, but the data set contains the flat one.
        flat = to_device(np.broadcast_to(board, simulated.points.shape))
        datasets.append(
            dataclasses.replace(simulated, points=flat, base_from_tool=part.base_from_tool)
        )
        joints_by_part.append(part.joints)
    return ArmScene(datasets[0], datasets[1], truth, joints_by_part[0], joints_by_part[1])


def joints_near_home(arm: SerialArm, base_from_tool: SE3) -> Float[Array, "views joints"]:
    """Return joint angles near `HOME_JOINTS` at which the tool has the wanted poses."""
    # The program takes seconds to compile; padded, it is the same for scenes of all usual sizes.
    near = np.tile(HOME_JOINTS, (len(base_from_tool.wxyz_xyz), 1))
    joints, reached = over_padded_views(
        lambda padded: solve_joints_iteratively(arm, *padded), (base_from_tool, near)
    )
    if not np.all(reached):
        raise RuntimeError(f"the arm reaches {np.sum(reached)} of {len(reached)} views")
    return joints


def board_points() -> Float[np.ndarray, "points 3"]:
    """Return the points of the flat board, m."""
    i, j = np.indices((9, 12)).reshape(2, -1)
    return 0.030 * np.stack([j, i, np.zeros(i.shape)], axis=1)


def true_calibration() -> Calibration:
    """Return a true calibration with the camera of the data set tampere_kuka_2.

    Its lens has a `k3` that the four fitted coefficients do not include.
    """
    lens = OpenCV5(-0.126, 0.0695, 1e-4, 3e-4, -0.03)
    camera = Camera(1056.0, 1056.0, 958.0, 587.0, lens, image_size=(1920, 1200))
    return calibration_of(camera, 0.55)


def random_kinematic_errors(
    arm: SerialArm,
    rng: np.random.Generator,
    scale: float,
    error_sigma: Mapping[str, float] = KINEMATIC_ERROR_SIGMA,
    outer_links: bool = False,
) -> RobotError:
    """Return random arm errors, on the middle links only or on all.

    Errors of the first and of the last link are indistinguishable from another target pose and
    another hand-eye transform: no camera can find them.
    """
    field = DHErrors(arm)
    # One row per link parameter (joint offset, d, a, alpha), one column per joint.
    sigmas = [
        sigma for name, n in field.groups for sigma in [error_sigma[name]] * (n // arm.joint_count)
    ]
    coefficients = np.zeros((len(sigmas), arm.joint_count))
    samples = np.array(sigmas)[:, None] * rng.standard_normal(coefficients.shape)
    # All random numbers are drawn and then masked, so that a seed gives the same errors for any
    # choice of links.
    links = slice(None) if outer_links else PERTURBED_LINKS
    coefficients[:, links] = scale * samples[:, links]
    return RobotError(field, to_device(coefficients.ravel()))


def _random_warp(
    board: Float[np.ndarray, "points 3"], max_deviation: float, rng: np.random.Generator
) -> Float[np.ndarray, "points 3"]:
    """Return the deviations of a warped board's points: a random quadratic, minus its plane.

    The largest deviation is `max_deviation`, m.
    """
    # Coordinates about the board's centre, in units of its longer side.
    x, y = ((board - board.mean(axis=0)) / np.ptp(board, axis=0).max())[:, :2].T
    # z = a x^2 + b x y + c y^2 with random a, b, c.
    deviation = np.stack([x * x, x * y, y * y], axis=1) @ rng.standard_normal(3)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    # A plane would only shift and rotate the board, which the pose of the target absorbs.
    deviation = deviation - plane @ np.linalg.lstsq(plane, deviation, rcond=None)[0]
    return np.stack([0.0 * x, 0.0 * x, max_deviation * deviation / np.abs(deviation).max()], axis=1)
