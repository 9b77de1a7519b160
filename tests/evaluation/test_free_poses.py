import cv2
import numpy as np
import pytest
from standard_scene import POINTS, VIEWS

from smartview_jax import Calibration, Camera
from smartview_jax.cameras import Radial
from smartview_jax.evaluation import free_pose_errors, reprojection_errors
from smartview_jax.simulation import paper_calibration, random_scene


@pytest.fixture(scope="module")
def noisy_robot():
    """A robot so noisy that the chain misses by many pixels; a camera without distortion."""
    truth = paper_calibration()
    camera = Camera(2133.0, 2133.0, 322.0, 238.0, Radial(0.0), image_size=(640, 480))
    truth = Calibration.eye_in_hand(camera, truth.camera_from_tool, truth.base_from_world)
    return random_scene(0, VIEWS, POINTS, truth, translation_noise=1e-3, rotation_noise=2e-3)


def test_every_view_gets_the_pose_that_opencv_finds(noisy_robot):
    scene = noisy_robot
    data, camera = scene.data, scene.calibration.camera
    found = free_pose_errors(scene.calibration, data)
    assert reprojection_errors(scene.calibration, data).rms > 20.0 * found.rms
    matrix = np.array([[2133.0, 0.0, 322.0], [0.0, 2133.0, 238.0], [0.0, 0.0, 1.0]])
    for view in range(6):
        seen = np.asarray(data.visible)[view]
        points, pixels = np.asarray(data.points)[view, seen], np.asarray(data.pixels)[view, seen]
        _, rvec, tvec = cv2.solvePnP(points, pixels, matrix, None)
        rvec, tvec = cv2.solvePnPRefineLM(
            points, pixels, matrix, None, rvec, tvec, (cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        )
        left = pixels - cv2.projectPoints(points, rvec, tvec, matrix, None)[0][:, 0]
        expected = np.linalg.norm(left, axis=1)
        np.testing.assert_allclose(found.px[view, seen], expected, atol=1e-4)
    assert camera.image_size == data.image_size


def test_a_view_without_points_stays_finite_and_empty(noisy_robot):
    scene = noisy_robot
    pixels = np.array(scene.data.pixels)
    pixels[1] = np.nan
    data = type(scene.data).from_arrays(
        scene.data.points, pixels, scene.data.base_from_tool, scene.data.image_size
    )
    found = free_pose_errors(scene.calibration, data)
    assert np.isnan(found.px[1]).all()
    assert found.unpredicted_count == 0
    everything = free_pose_errors(scene.calibration, scene.data)
    # Iterations that end elsewhere by rounding, far below the noise of 0.15 px.
    np.testing.assert_allclose(found.px[2:], everything.px[2:], atol=1e-6)
