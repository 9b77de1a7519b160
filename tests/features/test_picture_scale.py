"""The width of a picture's edges, and pictures that are reduced because their edges are wide."""

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.special import ndtr

import smartview_jax as sv
from smartview_jax.cameras import Pinhole
from smartview_jax.features import edge_width, picture_evidence, scaled_camera
from smartview_jax.features.gradient import Gradient
from smartview_jax.features.picture_scale import STANDARD_WIDTH, gradient_at, resized, scale_for

SIZE = (200, 160)


def camera(size=SIZE):
    return sv.Camera(300.0, 300.0, 0.5 * size[0], 0.5 * size[1], Pinhole(), size)


def steps(width, noise=0.5, size=SIZE):
    """A light square at an angle whose sides are blurred by a standard deviation, px."""
    u, v = np.meshgrid(*(np.arange(n) - 0.5 * n for n in size))
    turned = [0.9 * u + 0.44 * v, 0.9 * v - 0.44 * u]
    inside = np.prod([ndtr((0.27 * size[1] - np.abs(x)) / width) for x in turned], axis=0)
    grey = 60.0 + 100.0 * inside + np.random.default_rng(0).normal(0.0, noise, inside.shape)
    return np.clip(grey, 0.0, 255.0)


@pytest.mark.parametrize("width", [0.7, 1.2, 2.5])
@pytest.mark.parametrize("noise", [0.5, 1.5])
def test_the_width_of_edges_is_measured(width, noise):
    assert edge_width(Gradient.of(steps(width, noise))) == pytest.approx(width, rel=0.12)


def test_a_picture_without_strong_edges_has_no_width_and_is_not_reduced():
    width = edge_width(Gradient.of(np.random.default_rng(0).normal(100.0, 3.0, SIZE[::-1])))
    assert np.isnan(width)
    assert scale_for(width, SIZE) == 1.0


def test_pictures_with_wide_edges_are_halved():
    widths = STANDARD_WIDTH * np.array([1.0, 1.15, 2.0, 4.0])
    assert [scale_for(float(width), SIZE) for width in widths] == [1.0, 1.0, 0.5, 0.5]


@pytest.mark.parametrize(("width", "size"), [(0.4, (720, 160)), (0.71, SIZE), (0.35, SIZE)])
def test_enlarging_a_picture_does_not_change_the_size_at_which_it_is_searched(width, size):
    picture, large = steps(width, size=size).astype(np.uint8), (2 * size[0], 2 * size[1])
    enlarged = cv2.resize(picture, large, interpolation=cv2.INTER_LINEAR)
    scales = [
        scale_for(edge_width(Gradient.of(grey.astype(float))), grey.shape[::-1])
        for grey in (picture, enlarged)
    ]
    assert scales[0] == 2.0 * scales[1]


def test_no_picture_is_halved_to_one_that_would_be_enlarged():
    for side in (200, 640, 1000, 1280):
        for width in np.linspace(0.3, 2.5, 45):
            if scale_for(width, (side, side)) < 1.0:
                halved = 0.5 * np.sqrt(width**2 + 0.25)
                assert scale_for(halved, (side // 2, side // 2)) <= 1.0


@pytest.mark.parametrize("width", [0.0, 0.4, 0.55])
def test_only_small_pictures_with_sharp_edges_are_enlarged(width):
    scales = {side: scale_for(width, (side, side // 2)) for side in (100, 320, 400, 600, 1280)}
    assert scales[100] == scales[320] > scales[600] == scales[1280] == 1.0
    assert max(side * scale for side, scale in scales.items() if scale > 1.0) <= 640.0


def test_enlarging_a_small_picture_shows_the_corners_of_its_objects():
    """Smoothing by a pixel cuts the corners of a square of 43 px."""
    size = (100, 80)
    evidence = picture_evidence(steps(0.35, size=size).astype(np.uint8), camera(size))
    assert evidence.features.image_size == (200, 160)
    # Counted from the outer border of the first pixel.
    enlarged = (evidence.edge_points.pixels + 0.5) / evidence.scale - 0.5
    # Turned back, the sides are parallel to the axes.
    signs = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])
    gaps = []
    for points in (evidence.at(1.0, camera(size)).edge_points.pixels, enlarged):
        turned = (points - 0.5 * np.array(size)) @ np.array([[0.9, -0.44], [0.44, 0.9]])
        gaps.append(KDTree(turned).query(0.27 * size[1] * signs)[0].max())
    assert gaps[1] < 0.7 * gaps[0]


@pytest.mark.parametrize("scale", [2.0**0.5, 2.0])
def test_the_noise_of_an_enlarged_picture_is_known(scale):
    """Interpolation makes it smooth, so that it looks several times as small."""
    grey = np.random.default_rng(0).normal(120.0, 6.0, (480, 600))
    size = (round(600 * scale), round(480 * scale))
    gradient = gradient_at(scale, Gradient.of(grey), resized(grey, camera(size)))
    assert gradient.sigma == pytest.approx(gradient.by_u.std(), rel=0.03)


def test_an_enlarged_picture_has_the_edge_points_of_the_original():
    picture, size = steps(STANDARD_WIDTH).astype(np.uint8), (2 * SIZE[0], 2 * SIZE[1])
    enlarged = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR)
    original = picture_evidence(picture, camera())
    evidence = picture_evidence(enlarged, camera(size))
    assert (original.scale, evidence.scale) == (1.0, 0.5)
    assert evidence.grey.shape == enlarged.shape
    assert scaled_camera(camera(size), 0.5).image_size == evidence.features.image_size == SIZE
    points = original.edge_points.pixels
    assert len(evidence.edge_points.pixels) == pytest.approx(len(points), rel=0.05)
    gaps = KDTree(points).query(evidence.edge_points.pixels)[0]
    assert np.quantile(gaps, 0.9) < 0.5
    assert evidence.at(0.5, camera(size)) is evidence
    assert evidence.at(1.0, camera(size)).features.image_size == size


def test_evidence_without_its_picture_stays_at_its_scale():
    evidence = picture_evidence(steps(1.5).astype(np.uint8), camera())._replace(grey=None)
    with pytest.raises(ValueError, match="was not kept"):
        evidence.at(1.0, camera())


def test_a_resized_camera_sees_the_same_places():
    other = camera().resized((50, 40))
    rays = np.random.default_rng(0).normal((0.0, 0.0, 4.0), 1.0, (20, 3))
    full, small = (np.asarray(one.project(rays)[0]) for one in (camera(), other))
    # The outer border of the first pixel is at -0.5 in both.
    assert np.allclose(small + 0.5, (full + 0.5) / 4.0)
