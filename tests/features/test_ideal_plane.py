import cv2
import numpy as np
import pytest

from smartview_jax import features
from smartview_jax.cameras import Camera, Pinhole, Radial

SHORT = Camera(800.0, 800.0, 400.0, 290.0, Pinhole(), (800, 600))
LONG = Camera(1000.0, 990.0, 330.0, 235.0, Radial(0.5), (640, 480))


def refined(picture, start):
    """Corners as OpenCV finds them near a start."""
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    start = np.array(start, np.float32, order="C").reshape(-1, 1, 2)
    return cv2.cornerSubPix(picture, start, (9, 9), (-1, -1), end)[:, 0].astype(float)


def test_a_resampled_picture_shows_corners_where_their_rays_are():
    w, h = SHORT.image_size
    corners = np.array([[310.2, 230.7], [470.2, 250.7], [440.2, 370.7], [300.2, 340.7]])
    picture = np.full((h, w), 60, np.uint8)
    cv2.fillConvexPoly(picture, np.rint(16 * corners).astype(np.int32), 190, cv2.LINE_AA, 4)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    before = refined(picture, corners)
    assert np.linalg.norm(before - corners, axis=1).max() < 1.0
    expected = np.asarray(LONG.project(SHORT.unproject(before)[0])[0])
    after = refined(features.resampled(picture, SHORT, LONG), expected)
    assert np.linalg.norm(expected - after, axis=1).max() < 0.25
    with pytest.raises(ValueError, match="expected 800 x 600 px, the camera's size, found 10 x 9"):
        features.resampled(np.zeros((9, 10), np.uint8), SHORT, LONG)
