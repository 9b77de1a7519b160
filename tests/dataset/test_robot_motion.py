"""What the poses alone tell, before anything is fitted."""

import dataclasses

import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from jaxlie import SE3

from smartview_jax import calibrate, fit_joint
from smartview_jax.data_checks import views_to_use
from smartview_jax.dataset import (
    Dataset,
    never_turns,
    repeated_views,
    turns_about_one_axis,
    turns_about_one_point,
    undetermined_twists,
)
from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.hand_eye import solve_hand_eye
from smartview_jax.staged import fit_staged


@pytest.fixture(scope="module")
def data():
    return scene_of(3, MANY_VIEWS).data


def with_rows(data: Dataset, rows) -> Dataset:
    """The data with the robot's poses of these rows."""
    poses = np.asarray(data.base_from_tool.wxyz_xyz)[list(rows)]
    return dataclasses.replace(data, base_from_tool=SE3(poses))


def unturned(data: Dataset) -> Dataset:
    """The data with poses that all have the first one's orientation."""
    poses = np.array(data.base_from_tool.wxyz_xyz)
    poses[:, :4] = poses[0, :4]
    return dataclasses.replace(data, base_from_tool=SE3(poses))


def every_fit(data: Dataset):
    """Calls of every fit that takes poses of a robot."""
    truth = scene_of(3, MANY_VIEWS).calibration
    seen = truth.camera_from_world(data.base_from_tool)
    yield lambda: calibrate(data, "radial")
    yield lambda: fit_staged(data)
    yield lambda: fit_joint(data, truth, noise="trusted")
    yield lambda: solve_hand_eye(data.base_from_tool.inverse(), seen)


def test_equal_poses_are_refused_before_any_fit(data):
    for fit in every_fit(with_rows(data, [4] * MANY_VIEWS)):
        with pytest.raises(ValueError, match="all 16 robot poses are equal: the pose was not read"):
            fit()


def test_a_robot_that_never_turns_is_refused_before_any_fit(data):
    for fit in every_fit(unturned(data)):
        with pytest.raises(
            ValueError, match=r"never rotates: .* but not its translation\. .*start="
        ):
            fit()


def test_readings_of_a_standing_arm_flicker(data):
    poses = host_matrices(with_rows(data, [4] * MANY_VIEWS).base_from_tool)
    flicker = 1e-6 * np.random.default_rng(0).normal(size=(MANY_VIEWS, 6))
    still = dataclasses.replace(
        data, base_from_tool=SE3.from_matrix(poses @ host_exponentials(flicker))
    )
    with pytest.raises(ValueError, match="all 16 robot poses are equal"):
        views_to_use(still)


def test_poses_that_were_not_read_again_are_named_and_set_aside(data):
    rows = [k - (k % 3 == 1) for k in range(MANY_VIEWS)]
    stale = with_rows(data, rows)
    assert list(repeated_views(stale)) == [1, 4, 7, 10, 13]
    fit, good = fit_staged(stale), fit_staged(data)
    named = {view: text for view, point, text in fit.rejected if point is None}
    assert set(named) == {"1", "4", "7", "10", "13"}
    assert "repeats view 3's although the picture moved" in named["4"]
    shift = (fit.calibration.camera_from_tool.inverse() @ good.calibration.camera_from_tool).log()
    assert np.linalg.norm(shift[:3]) < 2e-3


def test_a_joint_fit_sets_them_aside_too(data):
    stale = with_rows(data, [k - (k % 3 == 1) for k in range(MANY_VIEWS)])
    truth = scene_of(3, MANY_VIEWS).calibration
    fit = fit_joint(stale, truth, noise="trusted")
    assert [view for view, point, _ in fit.rejected if point is None] == ["1", "4", "7", "10", "13"]
    assert sum("pose although the picture moved" in text for text in fit.warnings) == 1


def test_equal_poses_far_apart_are_left_to_the_other_views(data):
    """View 4 with the pose of view 9: nobody knows from the two which of them is wrong."""
    assert repeated_views(with_rows(data, [*range(4), 9, *range(5, MANY_VIEWS)])) == {}


def test_views_that_are_given_several_times_count_once(data):
    thrice = [k for _ in range(5) for k in range(3)]
    given = Dataset.from_arrays(
        np.asarray(data.points)[thrice],
        np.asarray(data.pixels)[thrice],
        host_matrices(data.base_from_tool)[thrice],
        data.image_size,
    )
    assert list(views_to_use(given)) == [0, 1, 2]
    assert "its picture and pose are given before, in view 2" in repeated_views(given)[5]


def test_a_raised_target_is_no_repetition(data):
    """Boards are pictured at several heights by a camera that stands still."""
    rows = [k - k % 2 for k in range(MANY_VIEWS)]
    points = np.asarray(data.points) + 0.01 * (np.arange(MANY_VIEWS) % 2)[:, None, None]
    raised = Dataset.from_arrays(
        points, data.pixels, host_matrices(with_rows(data, rows).base_from_tool), data.image_size
    )
    assert repeated_views(raised) == {}


def test_turns_tell_which_directions_are_open(data):
    poses = host_matrices(data.base_from_tool)
    assert not never_turns(poses)
    assert not turns_about_one_axis(poses)
    assert len(undetermined_twists(np.linalg.inv(poses))) == 0
    assert (
        len(undetermined_twists(np.linalg.inv(host_matrices(unturned(data).base_from_tool)))) == 3
    )
    turns = np.zeros((6, 6))
    turns[:, 5], turns[:, :2] = np.linspace(-0.6, 0.6, 6), [[0, 0], [1, 0], [0, 1]] * 2
    about_tool_z = poses[:1] @ host_exponentials(turns)
    assert turns_about_one_axis(about_tool_z)
    (twist,) = undetermined_twists(np.linalg.inv(about_tool_z))
    np.testing.assert_allclose(abs(twist[:3] @ poses[0, :3, 2]), 1.0, atol=1e-9)


def test_turns_about_one_point_tell_no_length(data):
    """A spherical wrist alone: the tool is 70 mm from its centre."""
    poses, rng = host_matrices(data.base_from_tool), np.random.default_rng(0)
    assert not turns_about_one_point(poses)
    turns = host_exponentials(rng.uniform(-0.5, 0.5, (12, 6)) * [0, 0, 0, 1, 1, 1])
    lever = np.array([0.0, 0.0, 0.07, 0.0, 0.0, 0.0])
    wrist = poses[0] @ turns @ host_exponentials(lever)
    noise = host_exponentials(rng.normal(size=(12, 6)) * 1e-3)
    assert turns_about_one_point(wrist @ noise)
    shifted = wrist.copy()
    shifted[:, :3, 3] += rng.normal(0.0, 0.02, (12, 3))
    assert not turns_about_one_point(shifted)
