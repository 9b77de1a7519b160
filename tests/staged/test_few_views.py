"""A known camera is placed by a view or two of a target whose place is known."""

import numpy as np
import pytest
from fit_scenes import POINTS

from smartview_jax.geometry import host_matrices
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.staged import start_by_target

TRUTH = paper_calibration()


def seen(count, points=POINTS, pixel_noise=0.0):
    """The first views of a scene."""
    return random_scene(3, 8, points, TRUTH, pixel_noise=pixel_noise).data.select(range(count))


@pytest.mark.parametrize("count", [1, 2])
def test_exact_views_give_the_place(count):
    start = start_by_target(seen(count), TRUTH.camera, TRUTH.holder_from_world)
    np.testing.assert_allclose(
        host_matrices(start.calibration.camera_from_mount),
        host_matrices(TRUTH.camera_from_mount),
        atol=1e-8,
    )
    assert start.warnings == ()
    assert start.inliers.all()


def small():
    """A plane of 4 mm, seen from 0.2 m."""
    grid = np.stack(np.meshgrid(np.arange(7), np.arange(2), [0]), axis=-1).reshape(-1, 3)
    return grid * [6e-4, 4e-3, 0.0] + POINTS.mean(axis=0)


def test_a_small_target_in_one_view_has_two_answers():
    one = start_by_target(seen(1, small(), 0.2), TRUTH.camera, TRUTH.holder_from_world)
    (warning,) = one.warnings
    assert "two answers explain the pictures about as well" in warning
    assert warning.endswith("Take another view in which the target is tilted more")


def test_a_point_that_lies_apart_is_left_out():
    data = seen(2)
    pixels = np.array(data.pixels)
    pixels[1, 3] += 40.0
    wrong = data.__class__.from_arrays(
        np.asarray(data.points), pixels, data.base_from_tool, data.image_size
    )
    start = start_by_target(wrong, TRUTH.camera, TRUTH.holder_from_world)
    assert np.argwhere(~start.inliers).tolist() == [[1, 3]]
    np.testing.assert_allclose(
        start.calibration.camera_from_mount.translation(),
        TRUTH.camera_from_mount.translation(),
        atol=1e-8,
    )


def test_views_that_tell_no_pose_are_named():
    with pytest.raises(ValueError, match=r"no view with 4 points \(view 0: "):
        start_by_target(seen(1).mask_views([0]), TRUTH.camera, TRUTH.holder_from_world)
