"""The camera matrix and the printed form of a camera."""

import cv2
import jax.numpy as jnp
import numpy as np

from smartview_jax.cameras import Camera, OpenCV4, Pinhole


def test_the_matrix_is_that_of_opencv():
    camera = Camera(1000.0, 1010.0, 320.0, 240.0, Pinhole(), (640, 480))
    points = np.array([[0.1, -0.2, 1.5], [0.3, 0.1, 2.0]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.asarray(camera.K), None)[0]
    np.testing.assert_allclose(camera.project(jnp.asarray(points))[0], expected[:, 0])


def test_a_printed_camera_is_the_call_that_makes_it():
    camera = Camera(1000.5, 1010.0, 320.0, 240.0, OpenCV4(-0.1, 0.02), (640, 480))
    again = eval(repr(camera), {"Camera": Camera, "OpenCV4": OpenCV4})
    np.testing.assert_allclose(again.K, camera.K)
    assert float(again.lens.k1) == -0.1
