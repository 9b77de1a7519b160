"""Single tags: each view has two poses, and the robot's motion chooses between them."""

import dataclasses

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared_data import shared_case

from benchmarks.single_tags import REAL_PLACE, REAL_TAG, place_of_camera, real_tag
from smartview_jax import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.geometry import as_se3, host_exponentials, host_matrices
from smartview_jax.simulation import random_viewpoints, simulate
from smartview_jax.staged import estimate_view_poses, fit_staged
from smartview_jax.staged.planar_poses import Sight, linearised, mirrored_poses, refined_poses
from smartview_jax.staged.two_poses import choose_poses
from smartview_jax.targets import TagGrid

CAMERA = Camera(1100.0, 1100.0, 640.0, 360.0, Pinhole(), (1280, 720))
HAND = host_exponentials(np.array([0.03, -0.06, 0.08, 0.5, -0.3, 1.0]))
WORLD = host_exponentials(np.array([0.5, 0.1, 0.05, 0.2, 0.1, 2.0]))


def tag_scene(mount, seed=0, views=14, side=0.025, aside=0.15):
    """A tag of 25 mm at about 0.8 m, which noise of 0.3 px turns over in some views."""
    truth = Calibration(CAMERA, as_se3(HAND), as_se3(WORLD), mount)
    rng = np.random.default_rng(seed)
    turns = np.zeros((views, 6))
    turns[:, 3:] = rng.uniform(-aside, aside, (views, 3))
    seen = host_matrices(random_viewpoints(rng, views, np.zeros(3), (0.7, 0.9), 0.7))
    commands = truth.command_for(as_se3(host_exponentials(turns) @ seen))
    return simulate(truth, commands, TagGrid(1, 1, side).points, seed, 0.3, 2e-4, 3e-4)


def turn_between(first, second):
    """Angle between the rotations of poses, rad."""
    trace = np.einsum("...ab,...ab->...", first[..., :3, :3], second[..., :3, :3])
    return np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))


def chosen(scene, **options):
    """The poses that leave least, and those that are chosen."""
    poses, _, _ = estimate_view_poses(scene.data.observations, CAMERA)
    robot = scene.data.mount_from_holder
    used = np.ones(scene.data.view_count, dtype=bool)
    choice = choose_poses(
        scene.data.observations, CAMERA, poses, robot, used, pixel_sigma=0.3, **options
    )
    return poses, choice


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_the_robot_tells_which_of_two_poses_is_right(mount):
    scene = tag_scene(mount)
    true = host_matrices(scene.calibration.camera_from_world(scene.base_from_tool))
    poses, choice = chosen(scene)
    before = turn_between(host_matrices(poses), true)
    after = turn_between(host_matrices(choice.camera_from_world), true)
    assert np.sum(before > 0.3) >= 2
    assert after.max() < 0.3
    assert set(np.flatnonzero(before > 0.3)) <= set(choice.exchanged)
    assert choice.explained
    assert choice.warning == ""


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_a_lens_that_zoomed_is_told_also_where_views_have_two_poses(mount):
    scene = tag_scene(mount, side=0.08)
    assert chosen(scene)[1] is not None
    pixels, middle = np.array(scene.data.pixels), 0.5 * np.array(CAMERA.image_size)
    pixels[7:] = middle + 1.05 * (pixels[7:] - middle)
    zoomed = dataclasses.replace(scene.data, pixels=jnp.asarray(pixels))
    warnings = fit_staged(zoomed, camera=CAMERA).warnings
    assert "from view 7 on, the focal length seems to be another (+5" in " ".join(warnings)


def test_a_camera_that_was_moved_is_not_explained_by_small_pictures():
    """Most views agree, which would excuse what the others say of robot and camera."""
    scene = tag_scene("eye_in_hand")
    poses = host_matrices(scene.data.base_from_tool).copy()
    poses[9:] = poses[9:] @ host_exponentials(np.array([0.05, 0.0, 0.0, 0.0, 0.2, 0.0]))
    moved = dataclasses.replace(scene.data, base_from_tool=as_se3(poses))
    _, choice = chosen(dataclasses.replace(scene, data=moved))
    assert not choice.explained


def test_a_large_board_is_not_asked():
    x, y = np.meshgrid(0.03 * np.arange(8), 0.03 * np.arange(6))
    points = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    scene = tag_scene("eye_in_hand")
    board = simulate(scene.calibration, scene.base_from_tool, points, 0, 0.3)
    assert chosen(board)[1] is None


def test_two_answers_are_said():
    """In the middle of every picture, and tiny: with both frames turned by half a turn it is
    seen as well."""
    scene = tag_scene("eye_in_hand", views=10, side=0.012, aside=0.0)
    assert "two answers explain the pictures about as well" in chosen(scene)[1].warning


def test_exchanged_views_are_named():
    scene = tag_scene("eye_in_hand")
    order = [0, 1, 2, 7, 4, 5, 6, 3, *range(8, 14)]
    poses = host_matrices(scene.data.base_from_tool)[order]
    wrong = dataclasses.replace(scene.data, base_from_tool=as_se3(poses))
    fit = fit_staged(wrong, camera=CAMERA)
    assert {view for view, point, _ in fit.rejected if point is None} == {"3", "7"}
    assert all("mispaired or moved?" in reason for _, _, reason in fit.rejected)


def test_poses_in_another_convention_are_refused_as_ever():
    scene = tag_scene("eye_in_hand")
    inverted = dataclasses.replace(
        scene.data, base_from_tool=as_se3(np.linalg.inv(host_matrices(scene.data.base_from_tool)))
    )
    with pytest.raises(ValueError, match="robot and camera do not move alike as given"):
        fit_staged(inverted, camera=CAMERA)


def test_a_start_decides():
    """What a person knows of the mount is refined, and chooses the poses."""
    scene = tag_scene("eye_in_hand", views=8)
    _, choice = chosen(scene, start=(as_se3(HAND), None))
    true = host_matrices(scene.calibration.camera_from_world(scene.base_from_tool))
    assert turn_between(host_matrices(choice.camera_from_world), true).max() < 0.3


def test_the_derivatives_by_a_pose_are_opencv_s():
    rng = np.random.default_rng(0)
    in_camera = rng.uniform((-0.2, -0.2, 0.5), (0.2, 0.2, 1.5), (2, 9, 3))
    seen = np.ones((2, 9), dtype=bool)
    seen[1, 4] = False
    identity = np.tile(np.eye(4), (2, 1, 1))
    _, jacobian, _ = linearised(identity, Sight(in_camera, np.zeros((2, 9, 2)), seen))
    for view in range(2):
        by_pose = cv2.projectPoints(in_camera[view], np.zeros(3), np.zeros(3), np.eye(3), None)[1]
        # OpenCV's columns begin with the rotation; a twist with the translation.
        expected = np.where(np.repeat(seen[view], 2)[:, None], by_pose[:, [3, 4, 5, 0, 1, 2]], 0.0)
        np.testing.assert_allclose(jacobian[view], expected, atol=1e-12)


def test_the_second_pose_is_the_other_minimum():
    """An exact view's mirrored pose leaves something, and a search ends where it leaves least."""
    points = np.tile(np.asarray(TagGrid(1, 1, 0.04).points), (2, 1, 1))
    poses = host_exponentials(
        np.array([[0.05, 0.02, 0.8, 0.5, 0.2, 0.1], [0.0, -0.1, 0.6, -0.1, 0.6, 2.0]])
    )
    p = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    sight = Sight(points, p[..., :2] / p[..., 2:], np.ones((2, 4), dtype=bool))
    second, left = refined_poses(mirrored_poses(poses, sight), sight)
    assert (turn_between(second, poses) > 0.5).all()
    assert (left > 1e-8).all()
    nudge = host_exponentials(1e-3 * np.random.default_rng(0).normal(size=(20, 2, 6)))
    for change in nudge:
        q = points @ (change @ second)[:, :3, :3].swapaxes(1, 2) + (change @ second)[:, None, :3, 3]
        assert (np.sum((q[..., :2] / q[..., 2:] - sight.rays) ** 2, axis=(1, 2)) > left).all()


@pytest.fixture(scope="module")
def real():
    """The tag on the hand of a real arm, the camera, and the staged fit."""
    shared_case(REAL_TAG.name)
    data, camera = real_tag()
    return data, camera, fit_staged(data, camera=camera)


def test_a_real_tag_on_a_hand_is_calibrated(real):
    """The joint fit, ten times closer to the pixels, is a row of `benchmarks single_tags`."""
    _, _, fit = real
    np.testing.assert_allclose(place_of_camera(fit.calibration), REAL_PLACE, atol=0.02)
    rms = np.sqrt(np.mean(np.sum(np.asarray(fit.residuals)[np.asarray(fit.inliers)] ** 2, axis=-1)))
    assert rms < 10.0
    # All views that see the tag are used.
    assert {reason for _, _, reason in fit.rejected} == {"0 points seen, 4 needed"}


def test_a_rough_start_of_a_real_tag_is_taken(real):
    data, camera, known = real
    actual, rough = known.calibration.camera_from_base, np.eye(4)
    rough[:3, 3] = REAL_PLACE
    rough[:3, :3] = (
        host_matrices(actual)[:3, :3].T @ Rotation.from_rotvec([0.2, 0.1, 0.0]).as_matrix()
    )
    fit = fit_staged(data, camera=camera, start={"camera_from_base": np.linalg.inv(rough)})
    shift = (actual.inverse() @ fit.calibration.camera_from_base).log()
    assert np.linalg.norm(shift) < 0.02
