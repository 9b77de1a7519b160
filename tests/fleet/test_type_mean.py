"""The errors that robots of a type have in common, against closed forms and drawn robots."""

import numpy as np
import pytest

from smartview_jax.fleet.type_mean import CommonErrorsOfType, TypeMean
from smartview_jax.robot_errors import JointOffsets, RobotPrior
from smartview_jax.robots import six_axes
from smartview_jax.variance import ErrorsOfRobot

FIELD, GENERAL = JointOffsets(six_axes()), RobotPrior()
MEDIAN = GENERAL.group_medians["joint_offset"]
TYPE_ZEROS = MEDIAN * np.array([0.0, 2.0, -1.0, 1.5, -2.0, 0.0])


def robots_of(count, type_zeros, own_std, seed=0, rows=4, view_noise=0.1):
    """Robots whose views tell four of six numbers, by other directions each."""
    rng, robots = np.random.default_rng(seed), []
    for _ in range(count):
        zeros = type_zeros + own_std * rng.standard_normal(6)
        design = rng.standard_normal((rows, 6)) / MEDIAN
        # The last joint's zero is never told.
        design[:, 5] = 0.0
        weight = view_noise**-2
        measured = design @ zeros + view_noise * rng.standard_normal(rows)
        information, vector = weight * design.T @ design, weight * design.T @ measured
        robots.append(ErrorsOfRobot(information, vector, np.full(6, own_std**2)))
    return robots


def common_of(robots, members=None):
    members = np.ones(len(robots)) if members is None else members
    return CommonErrorsOfType.of(FIELD, robots, members, GENERAL)


def test_the_mean_of_a_type_is_found_as_far_as_robots_tell_it():
    common = common_of(robots_of(40, TYPE_ZEROS, 0.3 * MEDIAN)).told_by_all
    errors = np.array(common.mean) - TYPE_ZEROS
    stds = np.array([std for _, std in common.mean_and_std.values()])
    assert (np.abs(errors[:5]) < 3.0 * stds[:5]).all()
    assert (stds[:5] < 0.2 * MEDIAN).all()
    # Of what no robot tells, the mean is zero, and as uncertain as the means of the others.
    assert common.mean[5] == pytest.approx(0.0, abs=1e-3 * MEDIAN)
    assert 0.5 * MEDIAN < stds[5] < 4.0 * MEDIAN


def test_robots_without_common_errors_have_none_and_two_prove_little():
    nothing = common_of(robots_of(40, np.zeros(6), 0.5 * MEDIAN)).told_by_all
    if nothing is not None:
        means = np.abs([mean for mean, _ in nothing.mean_and_std.values()])
        assert (means < 0.2 * MEDIAN).all()
    # Chance alone makes two robots somewhat alike: the mean is less certain than their errors.
    two = common_of(robots_of(2, np.zeros(6), 0.5 * MEDIAN)).told_by_all
    if two is not None:
        assert all(abs(mean) < 3.0 * std for mean, std in two.mean_and_std.values())


@pytest.mark.parametrize("count", [3, 40])
def test_robots_without_any_errors_have_none_in_common(count):
    """Not small ones either, for which the next robot would need a larger field."""
    assert common_of(robots_of(count, np.zeros(6), 0.0)).told_by_all is None
    exact = common_of(robots_of(count, TYPE_ZEROS, 0.0)).told_by_all
    np.testing.assert_allclose(exact.mean, TYPE_ZEROS, atol=0.1 * MEDIAN)


def test_a_robot_is_left_out_of_the_mean_that_it_is_compared_with():
    """The mean of the others, by the formula on dense matrices; one of another type has no part."""
    robots = robots_of(5, TYPE_ZEROS, 0.3 * MEDIAN)
    members = np.array([1.0, 1.0, 0.0, 1.0, 1.0])
    units, groups = np.full(6, MEDIAN), np.zeros(6, dtype=int)
    mean = TypeMean.of(robots, members, units, groups)
    found, covariance = mean.without(0)
    prior = mean.precision - mean.information_of_robots.sum(axis=0)
    precision, vector = prior.copy(), np.zeros(6)
    for robot in (robots[k] for k in (1, 3, 4)):
        # The covariance of what a robot's views tell, of what it deviates and of a vague rest.
        observed = np.linalg.pinv(robot.information * MEDIAN**2, rcond=1e-10)
        values, vectors = np.linalg.eigh(robot.information * MEDIAN**2)
        told = vectors[:, values > 1e-9 * values[-1]]
        spread = told.T @ (observed + 0.09 * np.eye(6)) @ told
        measured = told.T @ observed @ (robot.vector * MEDIAN)
        precision += told @ np.linalg.solve(spread, told.T)
        vector += told @ np.linalg.solve(spread, measured)
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found, np.linalg.solve(precision, vector), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(mean.without(2)[0], mean.of_all()[0])
