"""Pictures that a program binned or cut are named with their views; a knocked camera is not one.

OpenCV's projection and SciPy's rotations make the views.
"""

import dataclasses
import re

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax import Dataset
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.staged import fit_staged

VIEWS = 12
VIEW = np.arange(VIEWS)
KNOWN = Camera(900.0, 900.0, 640.0, 480.0, Pinhole(), (1280, 960))


def transform(turn, shift):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def with_resized(data, changed, size, shift):
    """The data with the pictures of some views resized, and then shifted by so many px."""
    pixels = np.array(data.pixels)
    pixels[changed] = size * (pixels[changed] + 0.5) - 0.5 + shift
    return dataclasses.replace(data, pixels=jnp.asarray(pixels))


@pytest.fixture(scope="module")
def board_views():
    """Views of a board of 12 x 7 points by a camera with a wide lens on a good robot."""
    rng = np.random.default_rng(0)
    points = np.array([[0.03 * x, 0.03 * y, 0.0] for y in range(7) for x in range(12)])
    hand_eye, world = (
        transform([5.0, -9.0, 80.0], [0.03, -0.05, 0.09]),
        transform([180.0, 0, 0], [0.5, 0.1, 0]),
    )
    intrinsics = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 480.0], [0.0, 0.0, 1.0]])
    pixels, poses = [], []
    for _ in VIEW:
        turn = Rotation.from_euler("xyz", rng.uniform([-35, -35, -60], [35, 35, 60]), degrees=True)
        seen = np.eye(4)
        seen[:3, :3] = turn.as_matrix()
        seen[:3, 3] = rng.uniform([-0.03, -0.03, 0.5], [0.03, 0.03, 0.6]) - turn.apply(
            points.mean(axis=0)
        )
        projected, _ = cv2.projectPoints(points, turn.as_rotvec(), seen[:3, 3], intrinsics, None)
        pixels.append(projected[:, 0] + rng.normal(0.0, 0.1, (len(points), 2)))
        error = transform(rng.normal(0.0, 0.02, 3), rng.normal(0.0, 2e-4, 3))
        poses.append(world @ np.linalg.inv(seen) @ hand_eye @ error)
    return Dataset.from_arrays(points, np.array(pixels), np.array(poses), image_size=(1280, 960))


@pytest.mark.parametrize(
    ("changed", "size", "shift", "text"),
    [
        (VIEW >= 7, 0.5, 0.0, r"from view 7 on, .* a factor of 0\.50\d and .* \(-?[01], -?[01]\)"),
        (VIEW % 3 == 1, 1.0, -90.0, r"in views 1, 4, 7, 10, .* \(-(89|9\d), -(89|9\d)\) px"),
    ],
)
@pytest.mark.parametrize("camera", [None, KNOWN])
def test_resized_and_cut_pictures_are_named(board_views, changed, size, shift, text, camera):
    data = with_resized(board_views, changed, size, shift)
    with pytest.raises(ValueError, match=f"^{text}"):
        fit_staged(data, camera=camera)


def test_a_resized_picture_of_a_known_camera_is_named_and_left_out(board_views):
    data = with_resized(board_views, VIEW == 8, 0.5, 0.0)
    # Next to the arm: the target's poses in the hand are the inverse ones.
    data = dataclasses.replace(
        data, mount="eye_to_hand", base_from_tool=data.base_from_tool.inverse()
    )
    staged = fit_staged(data, camera=KNOWN)
    named = [text for text in staged.warnings if "the pictures contradict the others" in text]
    assert re.match(r"in view 8, .* by a factor of 0\.50\d ", named[0])
    assert [view.view for view in staged.rejected if view.point is None] == ["8"]


def test_the_few_pictures_that_are_as_a_known_camera_took_them_are_named(board_views):
    data = with_resized(board_views, ~np.isin(VIEW, (3, 8)), 0.9, (20.0, -10.0))
    with pytest.raises(ValueError, match=r"^in all views but 3, 8, .* a factor of 0\.(89|90)\d "):
        fit_staged(data, camera=KNOWN)


def test_nothing_is_said_of_pictures_of_the_known_camera(board_views):
    staged = fit_staged(board_views, camera=KNOWN)
    assert staged.warnings == ()
    assert staged.conventions.change == ""


def test_a_knocked_camera_has_no_other_pictures(board_views):
    poses = host_matrices(board_views.base_from_tool).copy()
    poses[4:] = poses[4:] @ transform([0.0, 6.0, 0.0], [0.01, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"^from view 4 on, .* the camera had been moved"):
        fit_staged(dataclasses.replace(board_views, base_from_tool=as_se3(poses)))
