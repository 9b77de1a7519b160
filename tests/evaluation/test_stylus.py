import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.evaluation import stylus_error, touching_pose
from smartview_jax.robot_errors import LinearInPosition, RobotError
from smartview_jax.simulation import paper_calibration

TIP = np.array([0.01, -0.02, 0.15])
DOWN = Rotation.from_euler("XZ", [(np.pi, turn) for turn in (0.0, 1.0, 2.0)])
WAYS = SO3(jnp.asarray(DOWN.as_quat(scalar_first=True)))


def test_touching_puts_the_tip_where_it_is_wanted():
    place = np.array([0.1, 0.2, 0.3])
    for wanted, pose in (
        (np.zeros(3), touching_pose(TIP, WAYS)),
        (place, touching_pose(TIP, WAYS, place)),
    ):
        homogeneous = np.asarray(pose.as_matrix()) @ np.append(TIP, 1.0)
        np.testing.assert_allclose(homogeneous[:, :3], np.tile(wanted, (3, 1)), atol=1e-15)


def test_the_true_calibration_does_not_miss():
    truth = paper_calibration()
    miss = stylus_error(truth, truth, TIP, touching_pose(TIP, WAYS))
    np.testing.assert_allclose(miss, 0.0, atol=1e-14)


def test_a_misplaced_world_is_missed_by_as_much_whatever_the_camera():
    truth = paper_calibration()
    step = jnp.array([1e-3, -2e-3, 3e-3])
    base_from_world = SE3.from_translation(step) @ truth.base_from_world
    other = sv.Camera(1000.0, 900.0, 0.0, 0.0, truth.camera.lens, (640, 480))
    hand_eye = truth.camera_from_tool @ SE3.exp(jnp.full(6, 0.01))
    wrong = sv.Calibration.eye_in_hand(other, hand_eye, base_from_world)
    miss = stylus_error(wrong, truth, TIP, touching_pose(TIP, WAYS))
    wanted = truth.base_from_world.rotation().inverse().apply(step)
    np.testing.assert_allclose(miss, np.tile(wanted, (3, 1)), atol=1e-12)


def test_the_robot_noise_moves_the_tip():
    """The rotation acts over the length of the stylus, with the sign of `tool_from_base`."""
    truth = paper_calibration()
    noise = np.zeros((3, 6))
    noise[0, :3], noise[1, 3] = [1e-3, 0.0, 0.0], 1e-4
    poses = touching_pose(TIP, WAYS)
    miss = np.asarray(stylus_error(truth, truth, TIP, poses, noise))
    turned = np.asarray(poses.rotation().as_matrix())
    np.testing.assert_allclose(miss[0], turned[0] @ [-1e-3, 0.0, 0.0], atol=1e-12)
    assert np.linalg.norm(miss[1]) == pytest.approx(1e-4 * np.hypot(*TIP[1:]), rel=1e-3)
    np.testing.assert_allclose(miss[2], 0.0, atol=1e-14)


def test_an_error_of_the_robot_is_corrected_where_it_is_known():
    truth = paper_calibration()
    base_from_tool = truth.command_for(truth.camera_from_tool @ touching_pose(TIP, WAYS).inverse())
    field = LinearInPosition.from_poses(base_from_tool)
    error = RobotError(field, jnp.linspace(-2e-3, 2e-3, field.size))
    truth = dataclasses.replace(truth, robot_error=error)
    poses = touching_pose(TIP, WAYS)
    # What to command is found by iteration, to some nanometres.
    np.testing.assert_allclose(stylus_error(truth, truth, TIP, poses), 0.0, atol=1e-7)
    assert np.abs(stylus_error(truth.uncorrected, truth, TIP, poses)).max() > 1e-4


def test_a_pose_is_the_same_within_a_trace():
    place = np.array([0.1, -0.2, 0.3])
    traced = jax.jit(lambda wxyz: touching_pose(TIP, SO3(wxyz), place).wxyz_xyz)(WAYS.wxyz)
    np.testing.assert_allclose(traced, touching_pose(TIP, WAYS, place).wxyz_xyz, atol=1e-15)
