"""Views that disagree about an object, because the rig is wrong or the robot slipped."""

import dataclasses

import numpy as np
import pytest
from drawn_edges import TWO_DIRECTIONS, calibration, drawn, evidence, poses_towards, seen_views
from placed_box import MIDDLE, MODEL, POSE, error_of

from smartview_jax.engine import Noise
from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Hypothesis, VerdictOptions, localize
from smartview_jax.modeling import find_symmetry

BOX = dataclasses.replace(MODEL, name="box", symmetry=find_symmetry(MODEL))
PLAIN = dataclasses.replace(MODEL, name="box", symmetry=None)
TOLERANCE = 3e-4
SLIP = 1e-3 * np.array([0.0, 0.0, 0.0, 0.9, -0.6, 0.9])
"""A turn by 0.08 degrees, with which the edges are found in both views."""

EXACT = Noise(0.1, 1e-6, 1e-6)
"""A robot that is said to have hardly any noise."""


def found_with(slip, **more):
    """The box, drawn with the true poses, but the robot of the second view slipped."""
    pictures = drawn(BOX, seen_views(MIDDLE), POSE, 0.05, np.random.default_rng(0))
    poses = np.array(poses_towards(MIDDLE, TWO_DIRECTIONS))
    poses[1] = poses[1] @ host_exponentials(slip)
    starts = [Hypothesis(0, POSE, 0.0, 0.0)]
    (localization,) = localize(
        evidence(pictures), poses, calibration(), BOX, hypotheses=starts, **more
    )
    return localization


def squared_error(localization):
    error = error_of(localization.world_from_object)
    return error @ np.linalg.solve(localization.covariance, error)


def disagreement(localization):
    actual = localization.verdict.evidence.disagreement
    assert actual is not None
    return actual


@pytest.mark.parametrize("more", [{}, {"noise": EXACT}])
def test_views_of_a_right_rig_agree(more):
    localization = found_with(np.zeros(6), **more)
    assert localization.accepted
    assert disagreement(localization).as_stated > 0.5
    assert squared_error(localization) < 30.0


def test_a_slipped_robot_is_named_and_the_pose_not_accepted():
    localization = found_with(SLIP, noise=EXACT)
    assert localization.verdict.decision == "open"
    assert disagreement(localization).as_stated < 1e-6
    (reason,) = localization.verdict.reasons
    assert reason.startswith("views 0 and 1 disagree by 0.08")
    # Each view alone moves a model that is too large away from its camera.
    assert reason.endswith("or the object has another size than its model")


def test_noise_that_the_robot_is_known_to_have_is_no_disagreement():
    localization = found_with(SLIP, noise=Noise(0.1, 1e-3, 3e-3))
    assert localization.accepted
    assert disagreement(localization).as_stated > 0.5


def test_a_small_error_of_a_rig_that_is_taken_as_exact_is_in_the_covariance():
    localization = found_with(SLIP)
    assert localization.accepted
    assert disagreement(localization).as_stated < 1e-6
    # 30 is exceeded by chance once in 25,000 times.
    assert squared_error(localization) < 30.0


@pytest.mark.parametrize("factor", [5.0, 14.0])
def test_a_large_error_is_named_even_where_hardly_any_edge_is_found_in_all_views(factor):
    localization = found_with(factor * SLIP)
    noise = disagreement(localization)
    assert localization.verdict.decision == "open"
    assert localization.verdict.reasons == (noise.message,)
    # Seen from where it is, the camera turned by what the robot slipped.
    assert noise.turn == pytest.approx(factor * np.linalg.norm(SLIP), rel=0.15)
    assert squared_error(localization) < 30.0


def test_the_user_says_which_errors_are_tolerated():
    assert found_with(5.0 * SLIP, options=VerdictOptions(tolerated_arms=0.99999)).accepted


def test_an_object_within_the_tolerance_of_its_model_is_no_wrong_rig():
    """Where the model says nothing of it, the covariance is too small."""
    squared_errors = {0.0: [], TOLERANCE: []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        # The middle of an edge scatters by 1 / sqrt(2) as much as its ends.
        scattered = MODEL.vertices + np.sqrt(2.0) * TOLERANCE * rng.normal(size=(8, 3))
        made = dataclasses.replace(PLAIN, vertices=scattered, planar_tolerance=0.2)
        pictures = evidence(drawn(made, seen_views(MIDDLE), POSE, 0.05, rng))
        poses = poses_towards(MIDDLE, TWO_DIRECTIONS)
        for tolerance, squares in squared_errors.items():
            model = dataclasses.replace(PLAIN, tolerance=tolerance)
            starts = [Hypothesis(0, POSE, 0.0, 0.0)]
            (localization,) = localize(pictures, poses, calibration(), model, hypotheses=starts)
            error = error_of(localization.world_from_object)
            squares.append(error @ np.linalg.solve(localization.refined.covariance, error))
            if tolerance:
                assert localization.accepted, localization.message
    # 6 is expected; edges that meet at a vertex are not independent.
    assert np.mean(squared_errors[TOLERANCE]) < 14.0
    assert np.mean(squared_errors[0.0]) > 30.0


def test_one_view_agrees_with_itself():
    pictures = drawn(BOX, seen_views(MIDDLE), POSE, 0.05, np.random.default_rng(0))[:1]
    poses = np.array(poses_towards(MIDDLE, TWO_DIRECTIONS))[:1]
    starts = [Hypothesis(0, POSE, 0.0, 0.0)]
    (localization,) = localize(evidence(pictures), poses, calibration(), BOX, hypotheses=starts)
    assert localization.verdict.evidence.disagreement is None
