"""The region in which objects are looked for."""

import numpy as np
from solids import box

from smartview_jax.grasping import PlacedObject
from smartview_jax.picking import Region

REGION = Region(np.array([0.1, -0.1, 0.0]), (0.24, 0.18, 0.08))


def at(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return PlacedObject(box(0.06, 0.04, 0.03), pose)


def test_what_is_found_counts_by_its_middle():
    # The box's middle is 30, 20 and 15 mm from its corner.
    assert REGION.contains(at(0.07, -0.12, 0.0))
    assert REGION.contains(at(0.18, -0.12, 0.0))
    assert not REGION.contains(at(0.20, -0.12, 0.0))
    assert not REGION.contains(at(0.07, -0.12, 0.07))
    assert not REGION.contains(at(0.07, -0.12, -0.02))


def test_its_corners_are_those_of_a_box_on_its_floor():
    corners = REGION.corners
    assert np.allclose(corners.min(axis=0), [-0.02, -0.19, 0.0])
    assert np.allclose(corners.max(axis=0), [0.22, -0.01, 0.08])


def test_around_the_region_a_picture_fades_without_an_edge():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (400, 600)).astype(np.uint8)
    hull = np.array([[200.0, 100.0], [400.0, 100.0], [400.0, 300.0], [200.0, 300.0]])
    faded = Region.faded(picture, hull)
    assert np.array_equal(faded[110:290, 210:390], picture[110:290, 210:390])
    # Far away there is nothing but the mean, and half way half of the contrast.
    assert np.all(faded[:30] == faded[0, 0])
    beside = faded[150:250, 428:433].std() / picture[150:250, 428:433].std()
    assert 0.4 < beside < 0.6
    unseen = np.full((8, 2), np.nan)
    assert np.array_equal(Region.faded(picture, unseen), picture)
