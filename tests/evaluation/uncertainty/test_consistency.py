import numpy as np
import pytest
from scipy import stats

from smartview_jax.evaluation import coverage, mean_nees, nees, within_interval

RUNS = 2000


@pytest.fixture(scope="module")
def runs():
    """Errors drawn with a covariance of its own in every run, in units far apart."""
    rng = np.random.default_rng(0)
    units = np.array([1e-4, 1.0, 30.0])
    roots = rng.normal(size=(RUNS, 3, 4)) * units[:, None]
    covariances = np.einsum("rik,rjk->rij", roots, roots)
    errors = np.einsum("rik,rk->ri", roots, rng.normal(size=(RUNS, 4)))
    return errors, covariances


def test_squares_are_chi_square_distributed(runs):
    squares = nees(*runs)
    assert stats.kstest(squares, stats.chi2(3).cdf).pvalue > 0.01
    first = runs[0][0] @ np.linalg.inv(runs[1][0]) @ runs[0][0]
    assert squares[0] == pytest.approx(first, rel=1e-6)


def test_the_band_is_that_of_a_chi_square_mean(runs):
    found = mean_nees(nees(*runs), 3)
    assert found.is_consistent
    low, high = stats.chi2(3 * RUNS).interval(0.95)
    assert (found.low, found.high) == pytest.approx((low / RUNS, high / RUNS), rel=1e-9)
    too_sure = mean_nees(nees(runs[0], 0.9 * runs[1]), 3)
    assert not too_sure.is_consistent
    assert too_sure.value > too_sure.high


def test_intervals_hold_the_truth_as_often_as_they_say(runs):
    errors, covariances = runs
    std = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    found = coverage(within_interval(errors, std)[:, 0])
    assert found.is_consistent
    low, high = stats.binom(RUNS, 0.95).interval(0.95)
    assert (found.low, found.high) == pytest.approx((low / RUNS, high / RUNS), abs=1e-3)
    assert not coverage(within_interval(errors, 0.8 * std)[:, 1]).is_consistent


def test_few_degrees_of_freedom_widen_them():
    rng = np.random.default_rng(1)
    degrees = 4.0
    std = np.sqrt(rng.chisquare(degrees, 20 * RUNS) / degrees)
    errors = rng.normal(size=20 * RUNS)
    assert coverage(within_interval(errors, std, degrees)).is_consistent
    assert coverage(within_interval(errors, std)).value < 0.9
    edge = stats.t(degrees).interval(0.95)[1]
    one = np.ones(1)
    assert within_interval((edge - 1e-9) * one, one, degrees).all()
    assert not within_interval((edge + 1e-9) * one, one, degrees).any()


def test_a_covariance_that_is_none_is_named():
    covariances = np.stack([np.eye(2), 2.0 * np.ones((2, 2)) - np.eye(2)])
    with pytest.raises(ValueError, match="run 1: not finite and positive"):
        nees(np.zeros((2, 2)), covariances)
    with pytest.raises(ValueError, match="run 0: not finite"):
        nees(np.zeros((1, 2)), np.full((1, 2, 2), np.inf))
