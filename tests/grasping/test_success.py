"""Probabilities of success against SciPy's own integrals of the normal distribution."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm
from solids import box

from smartview_jax.grasping.candidates import candidate_grasps
from smartview_jax.grasping.success import (
    Conditions,
    grasp_conditions,
    success_probability,
)
from smartview_jax.modeling import grasp_on_face
from smartview_jax.robots import Gripper

IDEAL = Gripper(tolerance=0.0, min_hold=0.0, max_turn=1.5)
MODEL = box(0.06, 0.04, 0.03)
GRASP = grasp_on_face(MODEL, 1, opening_direction=np.array([0.0, 1.0, 0.0]), opening=0.05)
DRAWS_ERROR = 3e-3


@pytest.fixture(scope="module")
def candidate():
    import dataclasses

    model = dataclasses.replace(MODEL, grasps=(GRASP,))
    return min(candidate_grasps(model, IDEAL), key=lambda grasp: grasp.opening)


def covariance(**sigmas):
    matrix = np.zeros((12, 12))
    for name, sigma in sigmas.items():
        k = ["x", "y", "z", "rx", "ry", "rz", "tx", "ty", "tz"].index(name)
        matrix[k, k] = sigma**2
    return matrix


def probability(candidate, gripper=IDEAL, clearance=np.inf, **sigmas):
    conditions = grasp_conditions(candidate, gripper, clearance)
    return success_probability(conditions, covariance(**sigmas))[0]


def test_the_candidate_is_what_it_was_drawn_as(candidate):
    # 40 mm wide between fingers 50 mm apart, as deep as the default, 10 mm.
    assert np.isclose(candidate.width, 0.04)
    assert np.isclose(candidate.opening, 0.05)
    assert np.allclose(candidate.along_finger, (-IDEAL.finger_width, IDEAL.finger_width))


@pytest.mark.parametrize("sigma", [0.002, 0.005, 0.01])
def test_next_to_the_fingers_is_one_normal_integral(candidate, sigma):
    # 5 mm of room on either side.
    expected = norm.cdf(0.005 / sigma) - norm.cdf(-0.005 / sigma)
    assert abs(probability(candidate, x=sigma) - expected) < DRAWS_ERROR


def test_a_turn_moves_the_sides_at_the_fingers_edges(candidate):
    # At y = +-8 mm a turn by t moves a side by 8 mm t: 5 mm of room are 0.625 rad.
    sigma = 0.5
    expected = 2.0 * norm.cdf(0.005 / 0.008 / sigma) - 1.0
    assert abs(probability(candidate, rz=sigma) - expected) < DRAWS_ERROR


def test_the_depth_is_bounded_by_the_tips_and_by_the_palm(candidate):
    sigma = 0.02
    expected = norm.cdf(0.01 / sigma) - norm.cdf(-0.04 / sigma)
    assert abs(probability(candidate, z=sigma) - expected) < DRAWS_ERROR


def test_what_the_gripper_is_asked_to_keep_makes_it_harder(candidate):
    careful = Gripper(tolerance=2e-3, min_hold=8e-3, max_turn=1.5)
    sigma = 0.003
    x = 2.0 * norm.cdf(0.003 / sigma) - 1.0
    z = norm.cdf(0.002 / sigma) - norm.cdf(-0.04 / sigma)
    assert abs(probability(candidate, careful, x=sigma, z=sigma) - x * z) < DRAWS_ERROR


def test_the_gripper_s_own_error_must_stay_below_the_clearance(candidate):
    expected = (2.0 * norm.cdf(2.0) - 1.0) ** 3
    actual = probability(candidate, clearance=0.002, tx=0.001, ty=0.001, tz=0.001)
    assert abs(actual - expected) < DRAWS_ERROR


def test_correlated_errors_are_those_of_a_multivariate_normal():
    sigma = np.array([[4.0, 1.5], [1.5, 1.0]])
    matrix = np.zeros((4, 12))
    matrix[[0, 1, 2, 3], [0, 0, 1, 1]] = [1.0, -1.0, 1.0, -1.0]
    full = np.zeros((12, 12))
    full[:2, :2] = sigma
    actual, risks = success_probability(
        Conditions(matrix, np.array([2.0, 1.0, 0.5, 1.5]), ("a", "a", "b", "b")), full
    )
    normal = multivariate_normal(np.zeros(2), sigma)
    expected = normal.cdf(np.array([2.0, 0.5]), lower_limit=np.array([-1.0, -1.5]))
    assert abs(actual - expected) < DRAWS_ERROR
    alone = 1.0 - norm.cdf(2.0 / 2.0) + norm.cdf(-1.0 / 2.0)
    assert abs(risks["a"] - alone) < DRAWS_ERROR


def test_without_errors_it_is_certain(candidate):
    assert probability(candidate) == 1.0
