import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax import Dataset
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.simulation import six_axis_scene

SHAPE = {"views": 16, "held_out_views": 16}
QUIET = {"pixel_noise": 0.0, "translation_noise": 0.0, "rotation_noise": 0.0}
FLAT = {"warp_range": (0.0, 0.0)}


@pytest.fixture(scope="module")
def scenes():
    return [six_axis_scene(seed, **SHAPE) for seed in range(4)]


def test_an_exact_arm_over_a_flat_board_shows_the_projection_of_what_it_reports():
    scene = six_axis_scene(0, **SHAPE, **QUIET, **FLAT, error_scale=0.0)
    for data in (scene.data, scene.held_out):
        assert data.observation_count > 0.95 * data.visible.size
        assert reprojection_errors(scene.calibration.uncorrected, data).rms < 1e-9


def test_the_true_errors_of_the_arm_explain_what_its_joints_show():
    scene = six_axis_scene(1, **SHAPE, **QUIET, **FLAT).with_joint_readings
    for data in (scene.data, scene.held_out):
        assert reprojection_errors(scene.calibration, data).rms < 1e-9
        assert reprojection_errors(scene.calibration.uncorrected, data).rms > 0.3


def links_by_hand(joints, error):
    """Standard Denavit-Hartenberg links of the arm's published numbers, by SciPy's rotations."""
    theta, d, a, alpha = np.array(error).reshape(4, 6)
    d = d + np.array([0.4, 0.0, 0.0, 0.64, 0.0, 0.115])
    a = a + np.array([0.15, 0.6, 0.12, 0.0, 0.0, 0.0])
    alpha = alpha + np.deg2rad([-90.0, 0.0, -90.0, 90.0, -90.0, 0.0])
    theta = theta + joints + np.deg2rad([0.0, -90.0, 0.0, 0.0, 0.0, 0.0])
    pose = np.eye(4)
    for k in range(6):
        turn, twist = np.eye(4), np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", theta[k]).as_matrix()
        turn[2, 3] = d[k]
        twist[:3, :3] = Rotation.from_euler("x", alpha[k]).as_matrix()
        twist[0, 3] = a[k]
        pose = pose @ turn @ twist
    return pose


def test_reported_is_the_nominal_arm_and_true_the_wrong_one(scenes):
    scene = scenes[0]
    error = scene.calibration.robot_error
    nominal = links_by_hand(np.asarray(scene.joints[3]), np.zeros(24))
    told = scene.data.base_from_tool.as_matrix()[3]
    np.testing.assert_allclose(told, nominal, atol=1e-12)
    wrong = links_by_hand(np.asarray(scene.held_out_joints[3]), error.coefficients)
    camera_from_world = (
        np.asarray(scene.calibration.camera_from_tool.as_matrix())
        @ np.linalg.inv(wrong)
        @ np.asarray(scene.calibration.base_from_world.as_matrix())
    )
    by_joints = scene.with_joint_readings.held_out.command
    actual = scene.calibration.camera_from_world(by_joints).as_matrix()[3]
    np.testing.assert_allclose(actual, camera_from_world, atol=1e-12)


def test_errors_are_of_the_stated_size_on_the_middle_links(scenes):
    wrong = np.stack([s.calibration.robot_error.coefficients for s in scenes]).reshape(-1, 4, 6)
    np.testing.assert_array_equal(wrong[:, :, [0, 5]], 0.0)
    sizes = np.sqrt(np.mean(wrong[:, :, 1:5] ** 2, axis=(0, 2)))
    expected = [np.deg2rad(0.05), 3e-4, 3e-4, np.deg2rad(0.03)]
    np.testing.assert_allclose(sizes, expected, rtol=0.5)


def test_a_warped_board_leaves_its_plane_by_a_tenth_of_a_millimetre():
    """Heights by how far every point moves in all views, to first order."""
    flat, bent = (
        six_axis_scene(2, **SHAPE, **QUIET, warp_range=warp) for warp in ((0.0, 0.0), (1e-4, 1e-4))
    )
    shift = np.asarray(bent.data.pixels - flat.data.pixels)
    command, board = flat.with_joint_readings.data.command, np.array(flat.data.points[0])
    raised = board + np.array([0.0, 0.0, 1e-6])
    low, high = (flat.calibration.project(command, points)[0] for points in (board, raised))
    per_metre = np.where(np.isfinite(shift), np.asarray(high - low) / 1e-6, 0.0)
    heights = np.sum(np.nan_to_num(shift) * per_metre, axis=(0, 2))
    heights = heights / np.sum(per_metre**2, axis=(0, 2))
    assert np.abs(heights).max() == pytest.approx(1e-4, rel=0.01)
    plane = np.column_stack([np.ones(len(board)), board[:, :2]])
    np.testing.assert_allclose(np.linalg.lstsq(plane, heights)[0], 0.0, atol=1e-6)
    np.testing.assert_array_equal(bent.data.points, flat.data.points)


def test_noise_has_the_stated_size():
    noisy, quiet = (
        six_axis_scene(3, **SHAPE, **FLAT, **options)
        for options in ({"translation_noise": 0.0, "rotation_noise": 0.0}, QUIET)
    )
    errors = np.asarray(noisy.data.pixels - quiet.data.pixels)
    assert np.nanstd(errors) == pytest.approx(0.05, rel=0.05)
    np.testing.assert_array_equal(noisy.held_out.pixels, quiet.held_out.pixels)
    shaken = six_axis_scene(3, **SHAPE, **FLAT, pixel_noise=0.0)
    shift = np.nanstd(np.asarray(shaken.data.pixels - quiet.data.pixels))
    # 0.02 mm and 0.003 degrees at half a metre, seen by 1056 px.
    expected = 1056.0 * np.hypot(2e-5 / 0.525, np.deg2rad(0.003))
    assert shift == pytest.approx(expected, rel=0.3)
    np.testing.assert_array_equal(shaken.held_out.pixels, quiet.held_out.pixels)


def test_poses_are_told_unless_joints_are_asked_for(scenes):
    scene = scenes[0]
    assert scene.data.joints is None
    told = scene.with_joint_readings
    assert told.data.arm is not None
    np.testing.assert_allclose(
        told.data.base_from_tool.as_matrix(), scene.data.base_from_tool.as_matrix(), atol=1e-12
    )


def test_the_same_seed_gives_the_same_scene(scenes):
    again = six_axis_scene(0, **SHAPE)
    assert eqx.tree_equal(again, scenes[0])
    assert not jnp.allclose(scenes[0].joints, scenes[1].joints)
    assert isinstance(dataclasses.replace(again).data, Dataset)
