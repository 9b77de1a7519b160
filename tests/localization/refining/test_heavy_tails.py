"""Poses from edges whose errors have heavy tails: against draws of SciPy's Student's t."""

import numpy as np
import pytest
from scipy.stats import multivariate_t

from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.localization.refining.heavy_tails import solve_heavy_tailed
from smartview_jax.localization.refining.pose_equations import (
    CommonErrors,
    PoseEquations,
    solve_pose,
)

EDGES = 18
NO_ERRORS = CommonErrors(np.zeros((0, 0)), np.zeros((0, 0)))
TRUTH = np.array([1e-4, -2e-4, 3e-4, 1e-3, 2e-3, -1e-3])


def equations_of(rng, errors, numbers=0):
    """Equations of random edges, px by metres and radians, whose errors are in units of sigma."""
    edges = len(errors)
    by_pose = rng.standard_normal((2 * edges, 6)) * [3000.0, 3000.0, 3000.0, 60.0, 60.0, 60.0]
    sigmas = np.repeat(rng.uniform(0.005, 0.05, edges), 2)
    return PoseEquations(
        by_pose @ TRUTH + sigmas * errors.ravel(),
        by_pose,
        np.diag(sigmas**2),
        rng.standard_normal((2 * edges, numbers)),
        np.zeros((2 * edges, 0)),
    )


def drawn(rng, freedom, count=60, edges=EDGES):
    errors = multivariate_t.rvs(np.zeros(2), np.eye(2), freedom, count * edges, rng)
    return errors.reshape(count, edges, 2)


@pytest.mark.parametrize("freedom", [3.0, 1e6], ids=["heavy tails", "Gaussian"])
def test_the_covariance_is_true(freedom):
    rng, errors, covariances = np.random.default_rng(1), [], []
    for own in drawn(rng, freedom):
        step = solve_heavy_tailed(equations_of(rng, own), NO_ERRORS).step
        errors.append(step.tangent - TRUTH)
        covariances.append(step.covariance)
    value = mean_nees(nees(np.array(errors), np.array(covariances)), 6).value
    # The mean of 60 squares errs by 0.45. Few edges cannot exclude tails that would widen it.
    assert 4.7 < value < 7.3 if freedom < 10.0 else 4.5 < value < 6.5


@pytest.mark.parametrize("freedom", [2.0, 3.0, 1e6])
def test_many_edges_tell_how_heavy_their_tails_are(freedom):
    """The covariance is the inverse of Fisher's information of the errors' distribution."""
    rng, ratios = np.random.default_rng(9), []
    for errors in drawn(rng, freedom, 6, edges=150):
        equations = equations_of(rng, errors)
        covariance = solve_heavy_tailed(equations, NO_ERRORS).step.covariance
        gaussian = solve_pose(equations, NO_ERRORS).covariance
        ratios.append(np.linalg.det(covariance) / np.linalg.det(gaussian))
    # Of Student's t with two numbers: (nu + 2) / (nu + 4).
    expected = (freedom + 4.0) / (freedom + 2.0)
    assert np.mean(ratios) ** (1.0 / 6.0) == pytest.approx(expected, rel=0.12)


def test_few_edges_that_are_far_off_hardly_count():
    rng, robust, plain, none = np.random.default_rng(2), [], [], []
    for own in drawn(rng, 1e6):
        equations = equations_of(rng, own)
        off = equations.residuals.copy()
        off[:6] += rng.uniform(0.3, 1.0, 6)
        none.append(solve_pose(equations, NO_ERRORS).tangent - TRUTH)
        equations = equations._replace(residuals=off)
        fit = solve_heavy_tailed(equations, NO_ERRORS)
        robust.append(fit.step.tangent - TRUTH)
        plain.append(solve_pose(equations, NO_ERRORS).tangent - TRUTH)
        assert (fit.squared[:3] > 30.0).all()
        assert np.median(fit.squared) < 5.0
    robust, plain, none = (np.sqrt(np.mean(np.square(x)[:, 3:])) for x in (robust, plain, none))
    # Least squares without the three edges would not be much better.
    assert robust < 1.4 * none < 0.2 * plain


def test_a_light_that_moves_all_edges_of_a_picture_is_an_unknown():
    """Of two pictures; with the light as noise of each edge the pose would be as far off."""
    rng, errors, covariances, without = np.random.default_rng(7), [], [], []
    view = np.repeat(np.arange(EDGES) % 2, 2)
    for own in drawn(rng, 1e6, 20):
        equations = equations_of(rng, own)
        by_light = rng.uniform(0.1, 0.4, 2 * EDGES)[:, None] * (view[:, None] == [0, 1])
        residuals = equations.residuals + by_light @ rng.standard_normal(2)
        lit = equations._replace(residuals=residuals, by_light=by_light)
        fit = solve_heavy_tailed(lit, NO_ERRORS)
        assert fit.equations.by_light is None
        errors.append(fit.step.tangent - TRUTH)
        covariances.append(fit.step.covariance)
        without.append(solve_heavy_tailed(lit._replace(by_light=None), NO_ERRORS).step.tangent)
    errors, without = np.array(errors), np.array(without) - TRUTH
    assert 3.0 < mean_nees(nees(errors, np.array(covariances)), 6).value < 7.0
    assert np.sqrt((errors**2).mean()) < 0.3 * np.sqrt((without**2).mean())


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_an_error_of_all_edges_is_estimated(size):
    rng, sigmas = np.random.default_rng(3), []
    for own in drawn(rng, 1e6, 30):
        equations = equations_of(rng, own)
        shifts = np.zeros((EDGES, 2))
        shifts[:, 0] = size * rng.standard_normal(EDGES)
        moved = equations._replace(residuals=equations.residuals + shifts.ravel())
        sigmas.append(solve_heavy_tailed(moved, NO_ERRORS).edge_sigma)
    assert np.median(sigmas) == pytest.approx(size, abs=0.1)


def test_what_displaces_all_edges_by_less_than_their_noise_is_in_the_covariance():
    rng, errors, covariances = np.random.default_rng(8), [], []
    for own in drawn(rng, 1e6):
        equations = equations_of(rng, own)
        off = np.repeat(0.02 * rng.standard_normal(EDGES), 2) * np.tile([1.0, 0.0], EDGES)
        step = solve_heavy_tailed(
            equations._replace(residuals=equations.residuals + off), NO_ERRORS
        ).step
        errors.append(step.tangent - TRUTH)
        covariances.append(step.covariance)
    statistic = mean_nees(nees(np.array(errors), np.array(covariances)), 6)
    assert 4.5 < statistic.value < statistic.high


def test_units_of_the_calibrations_numbers_do_not_matter():
    rng = np.random.default_rng(4)
    equations = equations_of(rng, drawn(rng, 3.0, 1)[0], numbers=3)
    # The last number is known exactly.
    errors = CommonErrors(np.diag([4e-4, 1e-2, 0.0]), np.zeros((0, 0)))
    units = np.diag([1e3, 1e-3, 1e4])
    other = equations._replace(by_calibration=equations.by_calibration @ np.linalg.inv(units))
    changed = CommonErrors(units @ errors.calibration @ units, errors.vertices)
    first, second = solve_heavy_tailed(equations, errors), solve_heavy_tailed(other, changed)
    np.testing.assert_allclose(second.step.tangent, first.step.tangent, rtol=1e-7)
    np.testing.assert_allclose(second.squared, first.squared, rtol=1e-7)
    np.testing.assert_allclose(
        second.step.calibration_error, units @ first.step.calibration_error, rtol=1e-6, atol=1e-12
    )


def test_the_calibrations_errors_are_no_errors_of_edges():
    """All edges are off by what the calibration allows, and none of them by itself."""
    rng = np.random.default_rng(5)
    equations = equations_of(rng, drawn(rng, 1e6, 1)[0], numbers=2)
    true = np.array([0.8, -1.1])
    moved = equations._replace(residuals=equations.residuals + equations.by_calibration @ true)
    fit = solve_heavy_tailed(moved, CommonErrors(np.eye(2), np.zeros((0, 0))))
    np.testing.assert_allclose(fit.step.calibration_error, true, atol=0.05)
    # The points' noise is 0.005 to 0.05 px.
    assert fit.edge_sigma < 0.005
    assert fit.squared.max() < 14.0
    assert fit.step.absorbed == pytest.approx(2.0, abs=0.1)


def test_too_few_edges_are_an_error():
    rng = np.random.default_rng(6)
    equations = equations_of(rng, drawn(rng, 3.0, 1)[0])
    same = equations._replace(by_pose=np.tile(equations.by_pose[:2], (EDGES, 1)))
    with pytest.raises(ValueError, match="undetermined"):
        solve_heavy_tailed(same, NO_ERRORS)


def test_weights_that_leave_nothing_determined_say_so():
    """All that tells two numbers of the pose apart is an edge that is far off, and loses weight."""
    rng = np.random.default_rng(3)
    equations = equations_of(rng, np.zeros((EDGES, 2)))
    by_pose, off = equations.by_pose.copy(), equations.residuals.copy()
    by_pose[2:, 5] = by_pose[2:, 4]
    by_pose[:2, 5] = by_pose[:2, 4] * (1.0 + 1e-4)
    off[:2] += 1e3
    with pytest.raises(ValueError, match="undetermined"):
        solve_heavy_tailed(equations._replace(by_pose=by_pose, residuals=off), NO_ERRORS)
