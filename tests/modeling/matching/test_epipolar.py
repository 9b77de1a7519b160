import cv2
import numpy as np
import pytest
from polylines import nearest_on
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5, Pinhole, Radial
from smartview_jax.modeling import epipolar_curve, epipolar_curves

K = np.array([[600.0, 0.0, 310.0], [0.0, 620.0, 250.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.3, 0.12, 1e-3, -5e-4, -0.02])
A = np.eye(4)
B = np.eye(4)
B[:3, :3] = Rotation.from_rotvec([0.05, -0.35, 0.2]).as_matrix()
B[:3, 3] = [0.25, 0.03, -0.02]
PIXEL = np.array([420.0, 150.0])


def calibrated(lens):
    camera = sv.Camera(600.0, 620.0, 310.0, 250.0, lens, (640, 480))
    return sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))


@pytest.fixture(scope="module")
def pinhole():
    return calibrated(Pinhole())


@pytest.fixture(scope="module")
def distorted():
    return calibrated(OpenCV5(*DISTORTION))


def fundamental():
    """The matrix with x_b^T F x_a = 0, by its textbook formula."""
    b_from_a = np.linalg.inv(B) @ A
    t = b_from_a[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.linalg.inv(K).T @ cross @ b_from_a[:3, :3] @ np.linalg.inv(K)


def test_a_pinholes_curve_is_the_line_of_the_fundamental_matrix(pinhole):
    curve = epipolar_curve(pinhole, A, PIXEL, B, (0.3, np.inf))
    line = cv2.computeCorrespondEpilines(PIXEL.reshape(1, 1, 2), 1, fundamental())[0, 0]
    off = curve.pixels @ line[:2] + line[2]
    assert np.abs(off).max() < 1e-6
    assert (curve.piece == 0).all()
    assert np.linalg.norm(np.diff(curve.pixels, axis=0), axis=1).sum() > 300.0


def test_a_lens_bends_it_as_opencv_projects_the_ray(distorted):
    curve = epipolar_curve(distorted, A, PIXEL, B, (0.3, 5.0))
    normalised = cv2.undistortPointsIter(
        PIXEL.reshape(1, 1, 2), K, DISTORTION, None, None, (3, 100, 1e-14)
    )[0, 0]
    ray = np.array([*normalised, 1.0])
    points = curve.depths[:, None] * ray / np.linalg.norm(ray)
    b_from_a = np.linalg.inv(B)
    theirs = cv2.projectPoints(
        points, cv2.Rodrigues(b_from_a[:3, :3])[0], b_from_a[:3, 3], K, DISTORTION
    )[0][:, 0]
    # The two ends that the border cut lie between two samples.
    np.testing.assert_allclose(curve.pixels[1:-1], theirs[1:-1], atol=1e-6)
    np.testing.assert_allclose(curve.pixels, theirs, atol=2e-2)
    np.testing.assert_allclose(curve.depths[:, None] * curve.direction, points, atol=1e-9)
    along = curve.pixels[-1] - curve.pixels[0]
    aside = (curve.pixels - curve.pixels[0]) @ [-along[1], along[0]] / np.linalg.norm(along)
    assert np.abs(aside).max() > 2.0


def test_a_curve_is_cut_at_the_pictures_border(pinhole):
    curve = epipolar_curve(pinhole, A, PIXEL, B, (0.05, np.inf))
    low, high = -0.5 - 1e-9, np.array([639.5, 479.5]) + 1e-9
    assert ((curve.pixels >= low) & (curve.pixels <= high)).all()
    at_border = np.isclose(curve.pixels, -0.5).any(axis=1) | np.isclose(
        curve.pixels, [639.5, 479.5]
    ).any(axis=1)
    assert at_border[[0, -1]].any()


def test_distance_and_depth_of_a_pixel(distorted):
    point = np.array([0.06, -0.05, 0.8])
    pixels, _ = distorted.project(np.stack([A, B]), point[None])
    in_a, in_b = np.asarray(pixels)[:, 0]
    curve = epipolar_curve(distorted, A, in_a, B, (0.3, 5.0))
    distance, depth = nearest_on(curve, in_b)
    assert float(distance) < 0.01
    assert float(depth) == pytest.approx(np.linalg.norm(point), rel=1e-3)


def test_a_view_that_looks_away_has_no_curve(pinhole):
    away = B.copy()
    away[:3, :3] = Rotation.from_rotvec([0.0, np.pi, 0.0]).as_matrix()
    assert not len(epipolar_curve(pinhole, A, PIXEL, away, (0.3, 1.0)).pixels)


def test_a_curve_through_the_picture_between_two_samples_is_found(pinhole):
    """From so close that a hundredth of its depths crosses the picture."""
    curve = epipolar_curve(pinhole, A, PIXEL, B, (1e-4, np.inf))
    assert np.linalg.norm(np.diff(curve.pixels, axis=0), axis=1).sum() > 300.0


def test_many_views_give_what_one_gives(distorted):
    middle = B.copy()
    middle[:3, 3] *= 0.5
    both = epipolar_curves(distorted, A, PIXEL, np.stack([B, middle]), (0.3, 5.0))
    one = epipolar_curve(distorted, A, PIXEL, middle, (0.3, 5.0))
    np.testing.assert_allclose(both[1].pixels, one.pixels, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"pixel": [700.0, 10.0], "depths": (0.1, 1.0)}, "not in the picture"),
        ({"pixel": PIXEL, "depths": (1.0, 0.1)}, "nearest < farthest"),
    ],
)
def test_bad_input_is_named(pinhole, arguments, message):
    with pytest.raises(ValueError, match=message):
        epipolar_curve(pinhole, A, pose_b=B, **arguments)


def test_a_pixel_beyond_the_lens_is_refused():
    folding = calibrated(Radial(-3.0))
    with pytest.raises(ValueError, match="lens model"):
        epipolar_curve(folding, A, [639.0, 479.0], B, (0.1, 1.0))
