"""A sheet that bends otherwise in each view is told from a stiff board and from a wrong lens.

Pixels and poses are OpenCV's.
"""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.cameras import Camera, OpenCV4
from smartview_jax.data_checks import find_flexible_target
from smartview_jax.dataset import Observations
from smartview_jax.geometry import as_se3

VIEWS, SIGMA = 10, 0.05
GRID = np.array([[x, y, 0.0] for y in np.arange(6) * 0.025 for x in np.arange(9) * 0.025])
MATRIX = np.array([[700.0, 0.0, 322.0], [0.0, 701.0, 237.0], [0.0, 0.0, 1.0]])
CURVE = ((GRID[:, 0] - GRID[:, 0].mean()) / 0.1) ** 2
"""Height of a sheet that bends along x, over its height at 0.1 m from the middle."""


def found(bows, distortion=(-0.1, 0.03, 0.0, 0.0), noise=SIGMA, unusable=()):
    """What is found of a board whose rim is higher than its middle by a bow in each view, m.

    In unusable views the board seems to be behind the camera.
    """
    rng = np.random.default_rng(0)
    pixels, poses = np.empty((VIEWS, len(GRID), 2)), np.empty((VIEWS, 4, 4))
    straight = np.array([-0.1, 0.03, 0.0, 0.0])
    for view in range(VIEWS):
        turn = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3))
        shift = [*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.35, 0.5)] - turn.apply(
            GRID.mean(axis=0)
        )
        seen = GRID + np.outer(bows[view] * CURVE, [0.0, 0.0, 1.0])
        exact = cv2.projectPoints(seen, turn.as_rotvec(), shift, MATRIX, np.array(distortion))[0]
        pixels[view] = exact.reshape(-1, 2) + rng.normal(0.0, noise, (len(GRID), 2))
        # The pose that a camera finds which takes the board for flat.
        _, vector, place = cv2.solvePnP(GRID, pixels[view], MATRIX, straight)
        poses[view] = np.eye(4)
        poses[view, :3, :3], poses[view, :3, 3] = cv2.Rodrigues(vector)[0], place.ravel()
        if view in unusable:
            poses[view, :3, 3] *= -1.0
    visible = np.ones((VIEWS, len(GRID)), dtype=bool)
    points = np.broadcast_to(GRID, (VIEWS, *GRID.shape))
    observations = Observations(
        jnp.asarray(points), jnp.asarray(pixels), jnp.asarray(visible), as_se3(poses)
    )
    camera = Camera(700.0, 701.0, 322.0, 237.0, OpenCV4(*straight), (640, 480))
    inliers = visible & ~np.isin(np.arange(VIEWS), unusable)[:, None]
    return find_flexible_target(observations, inliers, camera, as_se3(poses))


@pytest.mark.parametrize("size", [5e-4, 2e-3])
def test_a_sheet_that_bends_otherwise_in_each_view_is_named_with_its_bow(size):
    bows = np.random.default_rng(1).normal(0.0, size, VIEWS)
    flexible = found(bows)
    # Both axes count, and the sheet bends along one.
    assert flexible.bow == pytest.approx(bows.std() / np.sqrt(2.0), rel=0.4)
    assert flexible.rms == pytest.approx(SIGMA * np.sqrt(2.0), rel=0.2)
    assert flexible.given_rms > 1.4 * flexible.rms
    assert "stiff, flat plate" in flexible.sentence


def test_a_stiff_board_is_left_in_peace_though_it_bows():
    assert found(np.zeros(VIEWS)) is None
    assert found(np.full(VIEWS, 2e-3)) is None


def test_a_lens_that_is_wrong_bends_no_board():
    for distortion in ((-0.2, 0.1, 0.0, 0.0), (-0.1, 0.03, 0.0, 0.0, 0.4), (-0.1, 0.03, 3e-3, 0.0)):
        assert found(np.zeros(VIEWS), distortion) is None


def test_noise_hides_a_small_bow():
    bows = np.random.default_rng(1).normal(0.0, 2e-4, VIEWS)
    assert found(bows, noise=0.02) is not None
    assert found(bows, noise=0.2) is None


def test_rendered_pictures_without_noise_bend_nothing():
    assert found(np.zeros(VIEWS), noise=0.0) is None
    # What steps of differences and the end of an iteration leave is no bow, whatever explains it.
    assert found(np.random.default_rng(1).normal(0.0, 1e-6, VIEWS), noise=0.0) is None


def test_a_view_that_is_not_used_may_be_behind_the_camera():
    bows = np.random.default_rng(1).normal(0.0, 2e-3, VIEWS)
    flexible = found(bows, unusable=(2,))
    assert flexible.bow == pytest.approx(np.delete(bows, 2).std() / np.sqrt(2.0), rel=0.4)
