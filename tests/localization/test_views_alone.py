"""The pose of an object in each view alone, near its pose in all views."""

import numpy as np
import pytest
from drawn_edges import drawn, evidence, seen_views
from placed_box import MIDDLE, MODEL, POSE, error_of

from smartview_jax.localization import corrected_rig
from smartview_jax.localization.edges.edge_lookup import checked_triangles
from smartview_jax.localization.judging.candidates import Prepared, Query
from smartview_jax.localization.judging.options import DEFAULT_OPTIONS
from smartview_jax.localization.judging.scene import Scene
from smartview_jax.modeling import CalibrationUncertainty

VIEWS = seen_views(MIDDLE)
NOWHERE = (0.0, 0.0)


@pytest.fixture(scope="module")
def scene():
    pictures = drawn(MODEL, VIEWS, POSE, 0.05, np.random.default_rng(0))
    return Scene(VIEWS, evidence(pictures), checked_triangles(None))


def seen_from(scene, pose, uncertainty):
    lookups = [corrected_rig._of_one_view(scene.lookup, view) for view in range(2)]
    query = Query([Prepared.of(MODEL)], uncertainty, DEFAULT_OPTIONS)
    place = corrected_rig.Place(0, pose, NOWHERE)
    return corrected_rig._poses_in_views(place, VIEWS, lookups, query)


def test_each_view_is_searched_as_far_as_a_wrong_camera_pose_displaces_it(scene):
    displaced = POSE.copy()
    # By 21 px along a diagonal of the first picture.
    displaced[:3, 3] += VIEWS.camera_from_world[0, :3, :3].T @ [4e-3, 4e-3, 0.0]
    seen = seen_from(scene, displaced, CalibrationUncertainty.none(VIEWS))
    assert [place.view for place in seen] == [0, 1]
    for place in seen:
        error = error_of(place.world_from_object)
        # 30 is exceeded by chance once in 25,000 times.
        assert error @ np.linalg.solve(place.covariance, error) < 30.0


def test_an_error_of_a_camera_pose_moves_what_its_view_shows_and_nothing_else(scene):
    uncertainty = CalibrationUncertainty.none(VIEWS).with_view_errors(1e-3, 2e-3)
    for place in seen_from(scene, POSE, uncertainty):
        by_camera = np.split(place.by_calibration, 2, axis=1)
        scale = np.abs(place.by_camera).max()
        np.testing.assert_allclose(by_camera[place.view], place.by_camera, atol=1e-3 * scale)
        np.testing.assert_array_equal(by_camera[1 - place.view], 0.0)
