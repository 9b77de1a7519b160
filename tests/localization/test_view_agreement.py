"""Views that disagree about an object, because the rig is wrong or the robot slipped."""

import dataclasses

import numpy as np
from drawn_edges import TWO_DIRECTIONS, calibration, drawn, evidence, poses_towards, seen_views
from placed_box import MIDDLE, MODEL, POSE, error_of

from smartview_jax.engine import Noise
from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Hypothesis, VerdictOptions, judge, localize
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
    (one,) = localize(evidence(pictures), poses, calibration(), BOX, hypotheses=starts, **more)
    return one


def test_views_of_a_right_rig_agree():
    one = found_with(np.zeros(6), noise=EXACT)
    assert one.accepted
    assert one.verdict.evidence.disagreement.probability > 0.01


def test_a_slipped_robot_is_named_and_the_pose_not_accepted():
    one = found_with(SLIP, noise=EXACT)
    assert one.verdict.decision == "open"
    assert one.verdict.evidence.disagreement.probability < 1e-6
    (reason,) = one.verdict.reasons
    assert reason.startswith("view 1 alone puts it 0.4")


def test_noise_that_the_robot_is_known_to_have_is_no_disagreement():
    assert found_with(SLIP, noise=Noise(0.1, 1e-3, 3e-3)).accepted


def test_a_rig_that_is_taken_as_exact_may_err_by_little():
    assert found_with(SLIP).accepted
    evidence = found_with(4.0 * SLIP).verdict.evidence
    assert evidence.disagreement.relative > VerdictOptions().exact_rig_error
    assert judge(evidence, 24, np.inf).reasons[-1].startswith("view 1 alone puts it")
    lenient = VerdictOptions(exact_rig_error=2.0 * evidence.disagreement.relative)
    assert not any("alone puts" in r for r in judge(evidence, 24, np.inf, options=lenient).reasons)


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
            (one,) = localize(pictures, poses, calibration(), model, hypotheses=starts)
            error = error_of(one.world_from_object)
            squares.append(error @ np.linalg.solve(one.refined.covariance, error))
            if tolerance:
                assert one.accepted, one.message
    # 6 is expected; edges that meet at a vertex are not independent.
    assert np.mean(squared_errors[TOLERANCE]) < 14.0
    assert np.mean(squared_errors[0.0]) > 30.0


def test_one_view_agrees_with_itself():
    pictures = drawn(BOX, seen_views(MIDDLE), POSE, 0.05, np.random.default_rng(0))[:1]
    poses = np.array(poses_towards(MIDDLE, TWO_DIRECTIONS))[:1]
    starts = [Hypothesis(0, POSE, 0.0, 0.0)]
    (one,) = localize(evidence(pictures), poses, calibration(), BOX, hypotheses=starts)
    assert one.verdict.evidence.disagreement is None
