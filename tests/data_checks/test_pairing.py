"""Inaccurate poses that belong together are told from wrong ones, however large the errors are."""

import numpy as np
import pytest
from robot_motions import moving_alike
from scipy.spatial.transform import Rotation

from smartview_jax.data_checks import check_conventions
from smartview_jax.data_checks.pairing import are_paired
from smartview_jax.geometry import host_transforms

VIEWS = 12
NOISES = [5.0, 10.0, 15.0, 20.0]
"""Standard deviations by axis, degrees; positions have 5 mm a degree."""


def inaccurate(degrees, seed=0):
    """Poses of robot and camera with so much noise."""
    return moving_alike(seed, noise=(5e-3 * degrees, degrees), views=VIEWS)


def report_on(robot, camera):
    """The report on a camera on the hand."""
    poses = map(host_transforms, (np.linalg.inv(robot), camera))
    return check_conventions(*poses, "eye_in_hand")


@pytest.mark.parametrize("degrees", NOISES)
def test_noise_of_any_size_leaves_poses_paired(degrees):
    robot, camera = inaccurate(degrees, seed=1)
    assert are_paired(robot, camera)
    order = np.random.default_rng(0).permutation(VIEWS)
    assert not are_paired(robot, camera[order])


@pytest.mark.parametrize(
    ("views", "wrong", "degrees", "seed"),
    [
        (6, 6, 0.02, 6),
        (6, 6, 0.02, 9),
        (12, 4, 0.02, 10),
        (12, 4, 0.02, 12),
        (12, 6, 0.02, 0),
        (40, 20, 5.0, 0),
        (40, 20, 5.0, 1),
    ],
)
def test_exchanged_rows_are_not_paired(views, wrong, degrees, seed):
    """Few rows in no order are better by chance in some respect, and half of many in another."""
    robot, camera = moving_alike(seed, noise=(5e-3 * degrees, degrees), views=views)
    order, rng = np.arange(views), np.random.default_rng(seed)
    rows = rng.choice(views, wrong, replace=False)
    order[rows] = np.roll(rows, 1)
    assert not are_paired(robot, camera[order])


def test_errors_in_proportion_to_the_motion_are_no_noise():
    """Every rotation is twice as large as it was; in any other order they agree less."""
    robot, camera = moving_alike(views=VIEWS)
    robot[:, :3, :3] = robot[:, :3, :3] @ robot[:, :3, :3]
    assert not are_paired(robot, camera)


@pytest.mark.parametrize("views", [8, 12, 20])
def test_rotations_with_a_wrong_scale_about_one_axis_are_no_noise(views):
    robot, camera = moving_alike(1, noise=(5e-4, 0.05), views=views)
    turns = Rotation.from_matrix(robot[:, :3, :3]).as_rotvec() * [1.0, 1.0, 0.3]
    robot[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    assert not are_paired(robot, camera)


def test_inaccurate_poses_are_a_doubt():
    report = report_on(*inaccurate(10.0))
    assert report.problems == ()
    assert report.inaccuracy.startswith("robot and camera agree only to 18.47 degrees and 101 mm")
    assert report.doubts[0] == report.inaccuracy
    assert report.is_contradicted
    assert not report.is_certain


def test_errors_of_a_camera_that_does_not_fit_are_no_noise():
    robot, camera = inaccurate(10.0)
    poses = map(host_transforms, (np.linalg.inv(robot), camera))
    report = check_conventions(*poses, "eye_in_hand", may_be_inaccurate=False)
    assert report.inaccuracy == ""
    assert report.problems[0].startswith("robot and camera do not move alike as given")


def test_wrong_poses_are_no_less_wrong_with_noise():
    """Inverted poses in ten degrees of noise agree better as given than in any other order."""
    robot, camera = inaccurate(10.0, seed=2)
    (problem,) = report_on(np.linalg.inv(robot), camera).problems
    assert "robot and camera do not move alike as given" in problem
