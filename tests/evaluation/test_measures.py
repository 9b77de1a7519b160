import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Calibration, Camera, Dataset
from smartview_jax.cameras import Pinhole
from smartview_jax.evaluation import ReprojectionErrors, reprojection_errors


@pytest.fixture(scope="module")
def looking_ahead():
    """f = 100 px, principal point (50, 50), target 2 m ahead, three points; the last is behind."""
    camera = Camera(100.0, 100.0, 50.0, 50.0, Pinhole(), image_size=(101, 101))
    ahead = SE3.from_translation(jnp.array([0.0, 0.0, 2.0]))
    return Calibration.eye_in_hand(camera, SE3.identity(), ahead)


def test_measures_are_what_they_say():
    px = np.array([[3.0, 4.0, np.nan], [0.0, 5.0, np.nan]])
    found = ReprojectionErrors(px, 1e-3 * px)
    assert found.mean == 3.0
    assert found.std == pytest.approx(np.std([3.0, 4.0, 0.0, 5.0]))
    assert found.rms == pytest.approx(np.sqrt(12.5))
    assert found.rms_mm == pytest.approx(np.sqrt(12.5))
    assert found.unpredicted_count == 0
    np.testing.assert_allclose(found.rms_per_view, [np.sqrt(12.5)] * 2)


def test_points_that_cannot_be_predicted_are_counted_and_change_no_figure():
    found = ReprojectionErrors(np.array([[3.0, np.inf], [4.0, np.nan]]), np.full((2, 2), np.inf))
    assert (found.mean, found.std, found.unpredicted_count) == (3.5, 0.5, 1)
    assert found.rms == pytest.approx(np.sqrt(12.5))
    assert np.isnan(found.rms_mm)


def test_nothing_seen_has_no_figure():
    nothing = ReprojectionErrors(np.full((2, 3), np.nan), np.full((2, 3), np.nan))
    figures = (nothing.mean, nothing.std, nothing.rms, nothing.rms_mm)
    assert np.isnan([*figures, *nothing.rms_per_view]).all()
    assert nothing.unpredicted_count == 0


def test_deviations_by_hand(looking_ahead):
    """A point 0.2 m right of the axis at 2 m lies at u = 60; measured at (63, 46) it is 5 px off.

    5 px x 2 m / 100 px = 0.1 m at the target.
    """
    points = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, -3.0]])
    pixels = np.array([[[50.0, 50.0], [63.0, 46.0], [10.0, 10.0]]])
    data = Dataset.from_arrays(points, pixels, np.eye(4)[None], (101, 101))
    found = reprojection_errors(looking_ahead, data)
    np.testing.assert_allclose(found.px, [[0.0, 5.0, np.inf]], atol=1e-12)
    np.testing.assert_allclose(found.metres, [[0.0, 0.1, np.inf]], atol=1e-12)
    assert found.unpredicted_count == 1


def test_a_point_that_was_not_seen_has_no_deviation(looking_ahead):
    pixels = np.array([[[50.0, 50.0], [np.nan, np.nan]]])
    points = np.zeros((2, 3))
    data = Dataset.from_arrays(points, pixels, np.eye(4)[None], (101, 101))
    np.testing.assert_array_equal(reprojection_errors(looking_ahead, data).px, [[0.0, np.nan]])
