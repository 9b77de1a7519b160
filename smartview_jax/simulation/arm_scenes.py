"""Simulate a six-axis arm with kinematic errors that views a warped board.

The controller reports the forward kinematics of the nominal arm. The real arm has other joint
zeros, link lengths and link twists, the lens has more distortion than its four fitted coefficients
describe, and the board is not flat. As in real set-ups, no estimator models all of it.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..calibration import Calibration
from ..cameras import Camera, OpenCV5
from ..dataset import Dataset
from ..robot_errors import DHErrors, RobotError
from ..robots import SerialArm, joints_near, six_axes
from .scenes import simulate, views_around

ERRORS = {
    "joint_offset": float(np.deg2rad(0.05)),
    "link_length": 3e-4,
    "link_twist": float(np.deg2rad(0.03)),
}
"""Standard deviations of the arm's errors, rad and m, by the groups of `DHErrors`."""

WRONG_LINKS = slice(1, 5)
"""Indices of the joints and links with errors: 2 to 5, counted from one.

Errors of the first and the last are equivalent to displacements of base and tool.
"""

NEAR = np.deg2rad([0.0, -10.0, 40.0, 0.0, 60.0, 0.0])
"""Joint angles, rad, at which the tool is above the table and points down."""

DISTANCE = (0.425, 0.625)
"""Smallest and largest distance from the camera to the board, m."""
TILT = float(np.deg2rad(30.0))
"""Largest angle between the viewing direction and the vertical, rad."""
WARP = (1e-4, 1.5e-4)
"""Smallest and largest deviation of the board from its plane, m."""


class ArmScene(eqx.Module):
    """A simulated data set of an arm, together with the truth behind it.

    Attributes:
        data: the data set of the experiment, with the poses that the robot reports as commands.
        unseen: held-out views, also with reported poses; their pixels have no noise, and the arm no
            random noise in them.
        calibration: the true calibration, whose robot error is that of the arm.
        joints: joint readings in the views of `data`, rad.
        unseen_joints: joint readings in the views of `unseen`, rad.
    """

    data: Dataset
    unseen: Dataset
    calibration: Calibration
    joints: Float[Array, "views joints"]
    unseen_joints: Float[Array, "unseen joints"]

    @property
    def by_joints(self) -> "ArmScene":
        """The same scene, with joint readings in its data sets."""
        arm = six_axes()
        data = self.data.with_joints(self.joints, arm)
        unseen = self.unseen.with_joints(self.unseen_joints, arm)
        return dataclasses.replace(self, data=data, unseen=unseen)


def six_axis_scene(
    seed: int = 0,
    views: int = 25,
    unseen: int = 40,
    errors: float = 1.0,
    pixel_noise: float = 0.05,
    translation_noise: float = 2e-5,
    rotation_noise: float = float(np.deg2rad(0.003)),
    warp: tuple[float, float] = WARP,
) -> ArmScene:
    """Return random views of a board of 12 x 9 points, 30 mm apart, by a 1056 px camera on an arm.

    Args:
        seed: seed of numpy's generator; the same seed gives the same scene.
        views: number of views to calibrate with.
        unseen: number of held-out views.
        errors: errors of the arm, as multiples of `ERRORS`.
        pixel_noise: standard deviation of `u` and of `v`, px.
        translation_noise, rotation_noise: as in `simulate`, in addition to the arm's errors; m and
            rad.
        warp: smallest and largest deviation of the board from its plane, m.

    Raises:
        RuntimeError: the arm does not reach a view.
    """
    rng = np.random.default_rng((seed, 3))
    arm, board = six_axes(), _board()
    error = _errors(arm, rng, errors)
    truth = dataclasses.replace(_calibration(), robot_error=error)
    bent = board + _warp(board, rng.uniform(*warp), rng)
    wanted = views_around(rng, views + unseen, board.mean(axis=0), DISTANCE, TILT)
    near = np.tile(NEAR, (views + unseen, 1))
    # The nominal arm is sent to the wanted views; the real arm misses them by its errors.
    joints, reached = joints_near(arm, truth.command_for(wanted, corrected=False), near)
    if not bool(reached.all()):
        raise RuntimeError(f"the arm reaches {int(reached.sum())} of {len(reached)} views")

    # Random noise applies to the views of the data only: held-out views test the repeatable part.
    #     true = error.true_pose(commanded) exp(noise)^-1
    size = np.repeat([translation_noise, rotation_noise], 3)
    noise = np.where(np.arange(views + unseen)[:, None] < views, size, 0.0)
    shaken = SE3.exp(jnp.asarray(noise * rng.standard_normal(noise.shape)))
    true = error.true_pose(arm.command(joints)) @ shaken.inverse()
    reported = arm.base_from_tool(joints)
    parts: list[Dataset] = []
    for part, sigma in ((slice(None, views), pixel_noise), (slice(views, None), 0.0)):
        pose, told = SE3(true.wxyz_xyz[part]), SE3(reported.wxyz_xyz[part])
        seen = simulate(truth.uncorrected, pose, bent, seed, sigma).data
        # The pixels show the warped board, but the data set states the flat one.
        flat = jnp.broadcast_to(jnp.asarray(board)[None], seen.points.shape)
        parts.append(dataclasses.replace(seen, points=flat, base_from_tool=told))
    data, judged_on = parts
    return ArmScene(data, judged_on, truth, joints[:views], joints[views:])


def _board() -> Float[np.ndarray, "points 3"]:
    """Return the points of the flat board, m."""
    i, j = np.indices((9, 12)).reshape(2, -1)
    return 0.030 * np.stack([j, i, np.zeros(i.shape)], axis=1)


def _calibration() -> Calibration:
    """Return a true calibration with the camera of the data set tampere_kuka_2.

    Its lens has a `k3` that the four fitted coefficients do not include.
    """
    lens = OpenCV5(-0.126, 0.0695, 1e-4, 3e-4, -0.03)
    camera = Camera(1056.0, 1056.0, 958.0, 587.0, lens, image_size=(1920, 1200))
    camera_from_tool = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(0.03, -0.05, 0.1), jnp.array([-0.02, 0.06, -0.09])
    )
    base_from_world = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(0.01, -0.02, 0.15), jnp.array([0.55, -0.12, 0.05])
    )
    return Calibration.eye_in_hand(camera, camera_from_tool, base_from_world)


def _errors(arm: SerialArm, rng: np.random.Generator, times: float) -> RobotError:
    """Return random arm errors, on the middle links only."""
    field = DHErrors(arm)
    rows = [size for name, n in field.groups for size in [ERRORS[name]] * (n // arm.size)]
    wrong = np.zeros((len(rows), arm.size))
    drawn = np.array(rows)[:, None] * rng.standard_normal(wrong.shape)
    # All random numbers are drawn and then masked, so that a seed gives the same errors for any
    # choice of links.
    wrong[:, WRONG_LINKS] = times * drawn[:, WRONG_LINKS]
    return RobotError(field, jnp.asarray(wrong.ravel()))


def _warp(
    board: Float[np.ndarray, "points 3"], most: float, rng: np.random.Generator
) -> Float[np.ndarray, "points 3"]:
    """Return the deviation of the points from a warped board: a random quadratic, minus its plane.

    The largest deviation is `most`, m.
    """
    x, y = ((board - board.mean(axis=0)) / np.ptp(board, axis=0).max())[:, :2].T
    bend = np.stack([x * x, x * y, y * y], axis=1) @ rng.standard_normal(3)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    # A plane would only shift and rotate the board, which the pose of the target absorbs.
    bend = bend - plane @ np.linalg.lstsq(plane, bend, rcond=None)[0]
    return np.stack([0.0 * x, 0.0 * x, most * bend / np.abs(bend).max()], axis=1)
