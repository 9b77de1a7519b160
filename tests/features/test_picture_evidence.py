import functools

import numpy as np
import pytest
from scipy.spatial import KDTree

import smartview_jax as sv
from smartview_jax.cameras import Fisheye, OpenCV5, Pinhole
from smartview_jax.features import (
    DISTANCE_STEP,
    FAR,
    ORIENTATIONS,
    UNSEEN,
    IdealPlane,
    evidence_of_points,
    picture_evidence,
)
from smartview_jax.features.picture_evidence import MAX_CELLS, ORIENTATION_TOLERANCE

SIZE = (640, 480)
QUAD = np.array([[-170.0, -150.0], [150.0, -120.0], [180.0, 90.0], [-140.0, 140.0]])
"""Corners in the ideal plane, px."""


def camera(lens=None, size=SIZE, focal=600.0):
    lens = Pinhole() if lens is None else lens
    return sv.Camera(focal, focal, size[0] / 2.0 - 3.0, size[1] / 2.0 + 2.0, lens, size)


def depth_inside(points, corners=QUAD):
    """Distance of points from the nearest side of a convex polygon, positive inside."""
    starts, along = corners, np.roll(corners, -1, axis=0) - corners
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    offset = points[:, None] - starts
    return (along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]).min(axis=1)


def picture_of(seen_by, scale=1.0):
    """A light polygon on a dark ground, straight in space, with a little noise."""
    width, rows = seen_by.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(rows)), axis=-1).reshape(-1, 2)
    ideal = IdealPlane(seen_by).from_pixels(pixels.astype(float))
    inside = np.clip(np.nan_to_num(depth_inside(ideal, scale * QUAD), nan=-1.0) + 0.5, 0.0, 1.0)
    noise = np.random.default_rng(0).normal(0.0, 1.0, inside.shape)
    grey = np.clip(60.0 + 120.0 * inside + noise, 0, 255)
    return grey.reshape(rows, width).astype(np.uint8)


CAMERAS = {
    "pinhole": camera(),
    "barrel": camera(OpenCV5(-0.3, 0.1, 0.0, 0.0, 0.0), focal=420.0),
    "fisheye": camera(Fisheye(0.0, 0.0, 0.0, 0.0), focal=300.0),
}


@functools.cache
def evidence_of(name):
    return picture_evidence(picture_of(CAMERAS[name]), CAMERAS[name])


@pytest.fixture
def evidence():
    return evidence_of("pinhole")


def centres(maps):
    rows, columns = maps.distances.shape[1:]
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    return maps.origin + maps.cell_size * cells


def test_maps_hold_the_distances_to_edges_of_each_direction(evidence):
    """The distances are asked from a tree over the points of each direction."""
    maps = evidence.maps
    angles = np.arctan2(maps.normals[:, 0], -maps.normals[:, 1])
    compared = 0
    for k in range(ORIENTATIONS):
        turn = (angles - k * np.pi / ORIENTATIONS + np.pi / 2) % np.pi - np.pi / 2
        own = maps.points[np.abs(turn) <= ORIENTATION_TOLERANCE]
        if not len(own):
            assert np.isin(maps.distances[k], (FAR, UNSEEN)).all()
            continue
        near = KDTree(own).query(centres(maps).reshape(-1, 2))[0].reshape(maps.distances[k].shape)
        known = maps.distances[k] < FAR
        ours = maps.distances[k][known] * DISTANCE_STEP * maps.cell_size
        assert np.abs(ours - near[known]).max() < 1.3 * maps.cell_size
        actual = np.linalg.norm(centres(maps)[known] - maps.points[maps.nearest[k][known]], axis=1)
        assert np.abs(actual - near[known]).max() < 1.3 * maps.cell_size
        compared += known.sum()
    assert compared > 10_000


def test_every_point_is_in_the_maps_of_its_own_direction_and_no_other(evidence):
    maps = evidence.maps
    cells = np.rint((maps.points - maps.origin) / maps.cell_size).astype(int)
    at = maps.distances[:, cells[:, 1], cells[:, 0]] == 0
    angles = np.arctan2(maps.normals[:, 0], -maps.normals[:, 1])
    own = np.rint(angles / np.pi * ORIENTATIONS).astype(int) % ORIENTATIONS
    assert at[own, np.arange(len(own))].all()
    across = (own + ORIENTATIONS // 2) % ORIENTATIONS
    # Where two sides of the polygon meet, both directions are near.
    assert at[across, np.arange(len(own))].mean() < 0.05


@pytest.mark.parametrize("name", CAMERAS)
def test_points_lie_on_straight_sides_with_normals_to_the_light(name):
    """The lens bends the sides by many px."""
    maps = evidence_of(name).maps
    gap = np.abs(depth_inside(maps.points))
    assert np.percentile(gap, 95) < 0.4
    # Each side is found along nearly all of its length; the polygon surrounds the origin.
    length = np.linalg.norm(QUAD - np.roll(QUAD, -1, axis=0), axis=1).sum()
    assert len(maps.points) > 0.85 * length
    assert ((maps.points * maps.normals).sum(axis=1) < 0.0).mean() > 0.97


def test_cells_that_the_picture_lacks_are_marked():
    unseen = evidence_of("barrel").maps.distances[0] == UNSEEN
    # A barrel-shaped picture fills the middle of its bounding box, not the middle of its sides.
    assert 0.005 < unseen.mean() < 0.4
    assert not unseen[unseen.shape[0] // 2, unseen.shape[1] // 2]


def test_large_pictures_have_maps_of_bounded_size():
    """A strip: the number of its pixels does not matter, but its longer side."""
    size = (1400, 240)
    large = camera(size=size, focal=1400.0)
    maps = picture_evidence(picture_of(large, 1400.0 / SIZE[0]), large).maps
    assert max(maps.distances.shape[1:]) <= 1.5 * MAX_CELLS + 2
    # A whole number of pixels, rounded up from 2.2.
    assert maps.cell_size == 3.0


def test_a_picture_that_nothing_can_be_found_in_is_refused():
    with pytest.raises(ValueError, match="blank"):
        picture_evidence(np.full(SIZE[::-1], 90, np.uint8), camera())


def test_segments_along_taken_edge_points_are_left_out():
    """As when an object is found: half of the picture is taken."""
    picture = np.full((240, 320), 60, np.uint8)
    picture[60:180, 40:120] = 180
    picture[60:180, 200:280] = 180
    camera = sv.Camera(300.0, 300.0, 160.0, 120.0, Pinhole(), (320, 240))
    evidence = picture_evidence(picture, camera, scale=1.0)
    free = evidence.edge_points.pixels[:, 0] > 160.0
    left = evidence_of_points(evidence, free, camera)
    middles = left.features.segments.mean(axis=1)
    assert len(middles) == 4
    assert (middles[:, 0] > 160.0).all()
    assert len(evidence.features.segments) == 8
    # Corners keep the segments that they still have, with their new indices.
    joined = left.features.corner_segments
    assert joined.max() == 3
    corners, of_two = left.features.corners, (joined >= 0).sum(axis=1) == 2
    assert of_two.sum() == 4
    for corner, pair in zip(corners[of_two], joined[of_two], strict=True):
        ends = left.features.segments[pair[:2]]
        assert np.linalg.norm(ends - corner, axis=2).min(axis=1).max() < 1e-6
    assert (left.maps.distances <= evidence.maps.distances).sum() < left.maps.distances.size
    assert evidence_of_points(evidence, np.ones_like(free), camera) is evidence
