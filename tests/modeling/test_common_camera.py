"""Two rigs look at one object: cameras of other focal lengths, lenses, sizes and hands."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax import features
from smartview_jax.calibration import Calibration
from smartview_jax.cameras import Camera, Pinhole, Radial
from smartview_jax.evaluation import mean_nees
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import common_camera, triangulate_points

LONG = Camera(2100.0, 2080.0, 330.0, 235.0, Radial(0.5), (640, 480))
SHORT = Camera(800.0, 800.0, 400.0, 290.0, Pinhole(), (800, 600))
POINTS = np.random.default_rng(0).uniform([-0.015, -0.01, 0.0], [0.015, 0.012, 0.02], (30, 3))
VIEWS = host_matrices(five_viewpoints(np.array([0.0, 0.0, 0.01]), 0.2))
"""Extrinsics of five views."""


def rig(camera, offset):
    """A calibration whose hand-eye transform is its own."""
    camera_from_tool = np.eye(4)
    camera_from_tool[:3, 3] = offset
    base_from_world = np.eye(4)
    base_from_world[:3, 3] = [0.3, 0.1, 0.2]
    return Calibration.eye_in_hand(camera, camera_from_tool, base_from_world)


RIGS = [rig(LONG, [0.0, 0.03, 0.1]), rig(SHORT, [0.02, 0.0, 0.05])]
CALIBRATIONS = [RIGS[0], RIGS[1], RIGS[1], RIGS[0], RIGS[1]]


def seen_by(calibration, view):
    in_camera = POINTS @ view[:3, :3].T + view[:3, 3]
    return np.asarray(calibration.camera.project(jnp.asarray(in_camera))[0])


@pytest.fixture(scope="module")
def poses():
    """What the robots report: from the camera's pose, through each rig's own hand-eye transform."""
    return np.stack(
        [
            host_matrices(calibration.command_for(view[None]))[0]
            for calibration, view in zip(CALIBRATIONS, VIEWS, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def pixels():
    return np.stack([seen_by(c, view) for c, view in zip(CALIBRATIONS, VIEWS, strict=True)])


def test_points_seen_by_two_rigs_are_where_they_are(poses, pixels):
    common = common_camera(CALIBRATIONS, poses)
    np.testing.assert_allclose(np.linalg.inv(common.base_from_tool), VIEWS, atol=1e-12)
    moved, covariances = common.pixels(pixels)
    found = triangulate_points(
        common.calibration, common.base_from_tool, moved, pixel_sigma=covariances
    )
    np.testing.assert_allclose(found.points, POINTS, atol=1e-9)
    # One of the two for all views is wrong by far more than clicks are.
    alone = triangulate_points(RIGS[1], poses, np.clip(pixels, 0.0, 599.0))
    assert not (np.linalg.norm(alone.points - POINTS, axis=1) < 1e-3).any()


def test_covariances_are_those_of_the_clicks_in_the_cameras_own_pixels(poses, pixels):
    common, sigma = common_camera(CALIBRATIONS, poses), 0.4
    squares = []
    for seed in range(20):
        noise = sigma * np.random.default_rng((seed, 1)).standard_normal(pixels.shape)
        moved, covariances = common.pixels(pixels + noise, sigma)
        found = triangulate_points(
            common.calibration, common.base_from_tool, moved, pixel_sigma=covariances
        )
        errors = found.points - POINTS
        squares += list(
            np.einsum("pi,pij,pj->p", errors, np.linalg.inv(found.covariance()), errors)
        )
    statistic = mean_nees(np.array(squares), 3)
    assert statistic.is_consistent, statistic
    # As if all pixels were the common camera's own, the short camera would be believed too much.
    assert np.sqrt(covariances[1, 0, 0, 0]) == pytest.approx(sigma * 2090.0 / 800.0, rel=0.01)
    assert np.sqrt(covariances[0, 0, 0, 0]) == pytest.approx(sigma, rel=0.05)


def test_every_pixel_has_its_place_and_what_is_not_seen_has_none(poses, pixels):
    common = common_camera(CALIBRATIONS, poses)
    size = np.array(common.calibration.camera.image_size)
    corners = np.zeros((5, 4, 2))
    for k, calibration in enumerate(CALIBRATIONS):
        w, h = calibration.camera.image_size
        corners[k] = [[-0.5, -0.5], [w - 0.5, -0.5], [-0.5, h - 0.5], [w - 0.5, h - 0.5]]
    moved, _ = common.pixels(corners)
    assert ((moved > 0.0) & (moved < size - 1.0)).all()
    hidden = pixels.copy()
    hidden[2, 5] = np.nan
    moved, covariances = common.pixels(hidden)
    assert np.isnan(moved[2, 5]).all()
    assert np.isfinite(moved).sum() == moved.size - 2
    np.testing.assert_array_equal(covariances[2, 5], np.eye(2))


def test_a_resampled_picture_shows_corners_where_their_pixels_went(poses):
    longer = rig(Camera(1000.0, 990.0, 330.0, 235.0, Radial(0.5), (640, 480)), [0.0, 0.0, 0.0])
    common = common_camera([longer, *CALIBRATIONS[1:3], longer, RIGS[1]], poses)
    w, h = SHORT.image_size
    corners = np.array([[310.2, 230.7], [470.2, 250.7], [440.2, 370.7], [300.2, 340.7]])
    picture = np.full((h, w), 60, np.uint8)
    cv2.fillConvexPoly(picture, np.rint(16 * corners).astype(np.int32), 190, cv2.LINE_AA, 4)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    moved, _ = common.pixels(np.broadcast_to(corners, (5, *corners.shape)))
    resampled = features.resampled(picture, SHORT, common.calibration.camera)

    def refined(picture, start):
        """Where the border of the figure turns, as OpenCV finds it near a start."""
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        start = np.array(start, np.float32, order="C").reshape(-1, 1, 2)
        return cv2.cornerSubPix(picture, start, (9, 9), (-1, -1), end)[:, 0]

    # What is found in the picture itself, where its pixels go.
    here = refined(picture, corners)
    assert np.linalg.norm(here - corners, axis=1).max() < 1.0
    expected, _ = common.pixels(np.broadcast_to(here, (5, *here.shape)))
    there = refined(resampled, moved[1])
    # Which is a fifth of a pixel of the short camera.
    assert np.linalg.norm(expected[1] - there, axis=1).max() < 0.25


def test_what_is_wrong_is_named(poses, pixels):
    with pytest.raises(ValueError, match="one for each of 5 poses, found 4"):
        common_camera(CALIBRATIONS[:4], poses)
    with pytest.raises(ValueError, match="one for each of 0 poses, found 0"):
        common_camera([], poses)
    sheared = poses.copy()
    sheared[3, 0, 0] += 0.1
    with pytest.raises(ValueError, match="view 3: not a rotation"):
        common_camera(CALIBRATIONS, sheared)
    wide = rig(Camera(100.0, 100.0, 499.5, 400.0, Pinhole(), (1000, 800)), [0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"view 4: its picture is too wide .* 76 degrees"):
        common_camera([*CALIBRATIONS[:4], wide], poses)
    with pytest.raises(ValueError, match="pixels: expected 5 views, found 3"):
        common_camera(CALIBRATIONS, poses).pixels(pixels[:3])
    with pytest.raises(ValueError, match="expected 800 x 600 px, the camera's size, found 10 x 9"):
        features.resampled(np.zeros((9, 10), np.uint8), SHORT, LONG)
