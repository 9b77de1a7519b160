"""Points that a lens model puts elsewhere near the border are told from wrong detections."""

import cv2
import numpy as np
import pytest

from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.data_checks import find_border_misfit
from smartview_jax.dataset import Dataset
from smartview_jax.geometry import as_se3, host_exponentials
from smartview_jax.targets import Chessboard

POINTS = Chessboard(8, 11, 0.03).points
CAMERA = Camera(800.0, 800.0, 640.0, 480.0, Pinhole(), (1280, 960))
VIEWS = 5
EVERY_VIEW = np.ones(VIEWS, dtype=bool)


def seen(k3=0.0, seed=0):
    """Views by OpenCV of a board that fills the picture, with a lens that bends at the border."""
    rng = np.random.default_rng(seed)
    poses = host_exponentials(rng.normal(0.0, 0.02, (VIEWS, 6)))
    poses[:, :3, 3] += [-0.15, -0.105, 0.27]
    lens = np.array([0.0, 0.0, 0.0, 0.0, k3])
    pixels = [
        cv2.projectPoints(POINTS, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], CAMERA.K, lens)[0]
        for pose in poses
    ]
    noise = rng.normal(0.0, 0.1, (VIEWS, len(POINTS), 2))
    return as_se3(poses), np.array(pixels)[:, :, 0] + noise


def found(poses, pixels):
    """What is found where all points are left out that the pinhole camera misses by a pixel."""
    tools = np.tile(np.eye(4), (VIEWS, 1, 1))
    inside = ((pixels >= 0.0) & (pixels < CAMERA.image_size)).all(axis=2)
    pixels = np.where(inside[..., None], pixels, np.nan)
    observations = Dataset.from_arrays(POINTS, pixels, tools, CAMERA.image_size).observations
    straight = seen()[1]
    inliers = inside & (np.linalg.norm(pixels - straight, axis=2) < 1.0)
    return find_border_misfit(observations, EVERY_VIEW, inliers, CAMERA, poses), inliers, pixels


@pytest.mark.parametrize("k3", [0.04, -0.04])
def test_a_lens_that_bends_at_the_border_is_found(k3):
    misfit, inliers, pixels = found(*seen(k3))
    left_out = np.isfinite(pixels).all(axis=2) & ~inliers
    radii = np.linalg.norm(pixels - [640.0, 480.0], axis=2)
    assert misfit.left_out == pytest.approx(np.count_nonzero(left_out), rel=0.1)
    assert misfit.radius == pytest.approx(radii[left_out].min(), rel=0.05)
    assert misfit.seen == np.count_nonzero(radii >= misfit.radius)
    assert misfit.largest == pytest.approx(
        np.linalg.norm(pixels - seen()[1], axis=2)[left_out].max(), abs=0.5
    )


def test_wrong_detections_are_no_lens():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        poses, pixels = seen()
        wrong = rng.random(pixels.shape[:2]) < 0.2
        pixels[wrong] += rng.normal(0.0, 10.0, (np.count_nonzero(wrong), 2))
        assert found(poses, pixels)[0] is None


def test_a_wrong_view_with_the_target_in_a_corner_is_no_lens():
    """Its points are displaced alike, which is outward there; others see the border as it is."""
    poses, pixels = seen()
    corner = (pixels > [700.0, 540.0]).all(axis=2)
    corner[1:] &= np.cumsum(corner[1:], axis=1) == 1
    pixels[corner] += 6.0
    assert found(poses, pixels)[0] is None


def test_few_of_the_points_at_the_border_are_no_lens():
    """As the tails of good points are, where the lens is wrong by a part of their noise."""
    poses, pixels = seen()
    rays = pixels - [640.0, 480.0]
    outward = np.random.default_rng(1).random(pixels.shape[:2]) < 0.1
    pixels[outward] += 2.0 * (rays / np.linalg.norm(rays, axis=2, keepdims=True))[outward]
    assert found(poses, pixels)[0] is None


def test_two_views_that_bend_are_no_lens():
    poses, pixels = seen()
    pixels[:2] = seen(0.04)[1][:2]
    assert found(poses, pixels)[0] is None
