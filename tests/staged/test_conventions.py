import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3, SO3
from shared_data import shared_pairs

from smartview_jax.cameras import Camera, OpenCV4
from smartview_jax.simulation import random_scene
from smartview_jax.staged import check_conventions
from smartview_jax.staged.weng import locate_views

VIEWS = 12


@pytest.fixture(scope="module")
def poses():
    scene = random_scene(4, views=VIEWS, translation_noise=2e-4, rotation_noise=2e-4)
    seen = scene.calibration.camera_from_world(scene.base_from_tool)
    return scene.data.base_from_tool, seen


def scaled(pose, factor):
    return SE3(pose.wxyz_xyz.at[:, 4:].multiply(factor))


def test_good_data_raise_no_suspicion(poses):
    report = check_conventions(*poses, "eye_in_hand")
    assert report.problems == ()
    assert report.suspicious_views == ()
    assert report.angle_mismatch < 1e-3
    assert report.length_ratio == pytest.approx(1.0, abs=0.05)


def test_inverted_poses_are_named(poses):
    robot, seen = poses
    (problem,) = check_conventions(robot.inverse(), seen, "eye_in_hand").problems
    assert "given as tool_from_base where base_from_tool is expected" in problem


@pytest.mark.parametrize(
    ("name", "prefix"),
    [("koide_charuco", "20230920_"), ("tampere_synthetic", "cs1_"), ("tampere_synthetic", "cs2_")],
)
def test_inverted_poses_of_nearly_one_axis_are_named(name, prefix):
    """There the rotations alone fit either way."""
    data, reference = shared_pairs(name, prefix)
    fx, fy, cx, cy, *distortion = reference["K"]
    camera = Camera(fx, fy, cx, cy, OpenCV4(*distortion), data.image_size)
    seen, _, _ = locate_views(data.observations, camera)
    robot = data.base_from_tool
    assert check_conventions(robot, seen, "eye_in_hand").problems == ()
    (problem,) = check_conventions(robot.inverse(), seen, "eye_in_hand").problems
    assert "given as tool_from_base where base_from_tool is expected" in problem


def test_the_wrong_mount_is_named(poses):
    (problem,) = check_conventions(*poses, "eye_to_hand").problems
    assert "on the hand (eye_in_hand)" in problem


@pytest.mark.parametrize(
    ("robot_factor", "target_factor", "text"),
    [
        (1e3, 1.0, "the robot's positions look like millimetres"),
        (1e2, 1.0, "the robot's positions look like centimetres"),
        (1.0, 1e3, "the target's points look like millimetres"),
    ],
)
def test_wrong_units_of_length_are_named(poses, robot_factor, target_factor, text):
    robot, seen = poses
    report = check_conventions(
        scaled(robot, robot_factor), scaled(seen, target_factor), "eye_in_hand"
    )
    assert text in report.problems[0]


def test_degrees_taken_for_radians_are_named(poses):
    robot, seen = poses
    vectors = jnp.rad2deg(robot.rotation().log())
    wrong = SE3.from_rotation_and_translation(SO3.exp(vectors), robot.translation())
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert "(degrees?)" in problem


def test_a_mispaired_view_is_pointed_out(poses):
    robot, seen = poses
    wrong = SE3(robot.wxyz_xyz.at[5].set(robot.wxyz_xyz[6]))
    report = check_conventions(wrong, seen, "eye_in_hand")
    assert report.problems == ()
    assert [view for view, _ in report.suspicious_views] == [5]
    assert "paired with the right pose?" in report.suspicious_views[0][1]


def test_a_hidden_view_is_not_asked(poses):
    robot, seen = poses
    wrong = SE3(robot.wxyz_xyz.at[5].set(robot.wxyz_xyz[6]))
    weights = jnp.ones(VIEWS).at[5].set(0.0)
    assert check_conventions(wrong, seen, "eye_in_hand", weights).suspicious_views == ()
    assert np.isfinite(check_conventions(wrong, seen, "eye_in_hand", weights).misfit).all()
