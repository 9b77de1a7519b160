"""Corners in depth pictures become points, from the depths about them."""

import cv2
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.cameras import Camera, OpenCV4

CAMERA = Camera(300.0, 302.0, 80.0, 60.0, OpenCV4(0.05, -0.02, 1e-3, -1e-3), (160, 120))


def plane_depths(normal=(0.2, -0.3, 1.0), distance=0.6):
    """The depth at every pixel of a plane n . x = d, and the rays."""
    v, u = np.mgrid[:120, :160].astype(float)
    rays = np.asarray(CAMERA.unproject(np.stack([u, v], axis=-1))[0])
    return distance / (rays @ np.array(normal)) * rays[..., 2], rays


def test_a_cloud_is_opencvs():
    depth, _ = plane_depths()
    cloud = sv.depth.cloud_from_depth(depth, CAMERA)
    v, u = np.mgrid[:120:17, :160:13].astype(float)
    pixels = np.column_stack([u.ravel(), v.ravel()])
    K = np.array([[300.0, 0.0, 80.0], [0.0, 302.0, 60.0], [0.0, 0.0, 1.0]])
    D = np.array([0.05, -0.02, 1e-3, -1e-3])
    ideal = cv2.undistortPoints(pixels[:, None], K, D)[:, 0]
    rows, columns = pixels[:, 1].astype(int), pixels[:, 0].astype(int)
    expected = np.column_stack([ideal, np.ones(len(ideal))]) * depth[rows, columns][:, None]
    np.testing.assert_allclose(cloud[rows, columns], expected, atol=1e-6)
    with pytest.raises(ValueError, match="expected 160 x 120 px, as of the camera, found"):
        sv.depth.cloud_from_depth(depth[::2], CAMERA)


def test_a_corner_is_known_better_than_its_depth():
    rng = np.random.default_rng(0)
    depth, _ = plane_depths()
    noisy = depth + 2e-3 * rng.normal(size=depth.shape)
    noisy[rng.random(depth.shape) < 0.2] = np.nan
    cloud = sv.depth.cloud_from_depth(noisy, CAMERA)
    pixels = rng.uniform([20.0, 20.0], [140.0, 100.0], (60, 2))
    points = sv.depth.points_at_pixels(cloud, pixels)
    exact = np.asarray(CAMERA.unproject(pixels)[0])
    exact = exact * (0.6 / (exact @ np.array([0.2, -0.3, 1.0])))[:, None]
    # Some 65 pixels are averaged, and the distance is as good as their mean.
    error = np.sqrt(np.mean((points - exact)[:, 2] ** 2))
    assert 0.5 < error / (2e-3 / np.sqrt(65.0)) < 1.5
    assert np.abs((points - exact)[:, :2]).max() < 1e-3


def test_depths_of_another_surface_are_left_out():
    depth, _ = plane_depths()
    # A table half a metre behind the target's border.
    depth[:, 84:] += 0.5
    cloud = sv.depth.cloud_from_depth(depth, CAMERA)
    (point,) = sv.depth.points_at_pixels(cloud, np.array([[81.0, 60.0]]))
    assert point @ np.array([0.2, -0.3, 1.0]) == pytest.approx(0.6, abs=1e-4)


def test_what_is_missing_is_nan():
    cloud = np.full((120, 160, 3), np.nan)
    pixels = np.array([[20.0, 20.0], [np.nan, 3.0]])
    assert np.isnan(sv.depth.points_at_pixels(cloud, pixels)).all()
    for wrong, message in (
        ((cloud[..., 0], pixels, 4), "cloud: expected shape"),
        ((cloud, pixels[0], 4), "pixels: expected shape"),
        ((cloud, pixels, 0), "radius: expected 1 px or more, found 0"),
    ):
        with pytest.raises(ValueError, match=message):
            sv.depth.points_at_pixels(*wrong)


def test_depth_pictures_have_the_stated_unit(tmp_path):
    numbers = np.array([[0, 1000], [65535, 250]], np.uint16)
    cv2.imwrite(str(tmp_path / "depth.png"), numbers)
    expected = np.array([[np.nan, 1.0], [65.535, 0.25]])
    found = sv.depth.read_depth_picture(tmp_path / "depth.png")
    np.testing.assert_allclose(found, expected)
    found = sv.depth.read_depth_picture(tmp_path / "depth.png", 1e-4)
    np.testing.assert_allclose(found, 0.1 * expected)
    cv2.imwrite(str(tmp_path / "grey.png"), numbers.astype(np.uint8))
    (tmp_path / "none.png").write_bytes(b"")
    for name, unit, message in (
        ("grey.png", "mm", r"grey\.png: expected depths of one channel with 16 bits"),
        ("none.png", "mm", r"none\.png: no readable picture"),
        ("depth.png", "inch", "unit: expected .*, found 'inch'"),
        ("depth.png", -1.0, r"unit: expected metres above 0, found -1\.0"),
    ):
        with pytest.raises(ValueError, match=message):
            sv.depth.read_depth_picture(tmp_path / name, unit)
    with pytest.raises(FileNotFoundError, match=r"other\.png: no such picture"):
        sv.depth.read_depth_picture(tmp_path / "other.png")
