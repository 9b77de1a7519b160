"""How far away the views stand that are proposed in addition to given candidates."""

import numpy as np
import pytest
from drawn_edges import TWO_DIRECTIONS, calibration, drawn, evidence, poses_towards, seen_views
from solids import box

from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Hypothesis, Reachable, localize, next_view

MODEL = box(name="box")
POSE = host_exponentials(np.array([0.8, 0.1, 0.0, 0.1, -0.1, 0.4]))
MIDDLE = POSE[:3, :3] @ MODEL.vertices.mean(axis=0) + POSE[:3, 3]
POSES = poses_towards(MIDDLE, TWO_DIRECTIONS)


@pytest.fixture(scope="module")
def found(few_samples):
    """A box far from the world's origin."""
    pictures = evidence(drawn(MODEL, seen_views(MIDDLE), POSE, 0.1))
    start = Hypothesis(0, POSE, 0.0, 0.0)
    return localize(pictures, POSES, calibration(), MODEL, hypotheses=[start])


def next_of(localizations, candidates, **given):
    return next_view(localizations, calibration(), Reachable(candidates, **given))


def distance_of(view):
    centre = np.linalg.inv(view.camera_from_world)[:3, 3]
    return np.linalg.norm(centre - MIDDLE)


def test_the_papers_view_stands_where_candidates_stand_from_the_object(found):
    # As many look the other way: the median of all would be zero.
    away = POSES @ np.diag([-1.0, 1.0, -1.0, 1.0])
    for candidates in (POSES, np.concatenate([POSES, away])):
        view = next_of(found, np.linalg.inv(candidates))
        # The candidates look at the box's middle from 0.4 m, the paper's view at its top surface.
        assert abs(distance_of(view.paper) - 0.4) < 0.02
    given = next_of(found, np.linalg.inv(POSES), distance=0.3)
    assert abs(distance_of(given.paper) - 0.3) < 0.02


def test_one_candidate_needs_no_batch(found):
    candidates = np.linalg.inv(POSES[:1])
    one, batch = next_of(found, candidates[0]), next_of(found, candidates)
    np.testing.assert_array_equal(one.camera_from_world, batch.camera_from_world)
    assert one.gain == batch.gain


@pytest.mark.parametrize(
    ("candidates", "said"),
    [
        (np.zeros((0, 4, 4)), r"expected one pose or more, \(n, 4, 4\); found shape \(0, 4, 4\)"),
        (POSES @ np.diag([-1.0, 1.0, -1.0, 1.0]), "behind the camera in all 2 views"),
    ],
)
def test_candidates_that_are_none_are_refused(found, candidates, said):
    with pytest.raises(ValueError, match=said):
        next_of(found, np.linalg.inv(candidates) if len(candidates) else candidates)


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (np.diag([1.1, 1.1, 1.1, 1.0]), "candidate 1: not a rotation: R\\^T R differs"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "candidate 1: not a rotation: the determinant is -1"),
        (np.full((4, 4), np.nan), "candidate 1: the pose contains NaN"),
    ],
    ids=["scaled", "mirrored", "no number"],
)
def test_a_candidate_that_is_no_pose_is_named(found, scale, said):
    """Its command would be another pose, or it would be left out."""
    candidates = np.linalg.inv(POSES)
    candidates[1] = candidates[1] @ scale
    with pytest.raises(ValueError, match=f"camera_from_world: {said}"):
        next_of(found, candidates)


def test_candidates_in_millimetres_are_refused(found):
    candidates = np.linalg.inv(POSES)
    candidates[:, :3, 3] *= 1e3
    with pytest.raises(ValueError, match="camera_from_world: expected metres, up to 100; found"):
        next_of(found, candidates)


@pytest.mark.parametrize("distance", [0.0, -0.3, float("nan"), float("inf"), 300.0])
def test_a_distance_is_positive_and_in_metres(found, distance):
    with pytest.raises(ValueError, match="distance: expected metres, more than 0"):
        next_of(found, np.linalg.inv(POSES), distance=distance)
