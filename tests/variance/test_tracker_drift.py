"""The random walk of a tracker: against SciPy's normal distribution with all covariances dense."""

import sys

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal
from tracked_scene import MOUNT, VIEWS, WORLD, tracked

from smartview_jax.dataset import PoseDataset
from smartview_jax.variance import (
    LogNormalPriors,
    Walk,
    likeliest_walk,
    linear_pairs,
    walk_log_evidence,
)
from smartview_jax.variance.tracker_drift import solved_walk
from smartview_jax.variance.walk_slopes import deviance_slopes

USED = np.arange(VIEWS) % 5 != 2
LOGARITHMS = np.log([0.6, 1.5, 0.4, 0.1, 0.03, 2.0, 1.2, 0.3])


@pytest.fixture(scope="module")
def walk():
    robot, measured = tracked(0)
    data = PoseDataset.from_poses(robot, measured)
    pairs = linear_pairs(data, MOUNT, np.linalg.inv(robot), WORLD)
    by_field = np.random.default_rng(0).normal(size=(VIEWS, 6, 5))
    return Walk.of(pairs, USED, by_field, np.full(5, 1e-3), drifts=True)


def dense(walk, logarithms):
    """Covariance of all errors in used views, and their change by the unknowns."""
    parts = len(walk.pairs.parts)
    sizes = np.exp(logarithms)
    size = 6 * VIEWS
    covariance = np.zeros((size, size))
    for view in range(VIEWS):
        rows = slice(6 * view, 6 * view + 6)
        covariance[rows, rows] = np.tensordot(sizes[:parts] ** 2, walk.pairs.parts[:, view], axes=1)
    # Every new error moves its own view and all later ones.
    news = np.diag(np.repeat([1e-3 * sizes[parts + 1], 1e-2 * sizes[parts + 2]], 3) ** 2)
    for new in range(1, VIEWS):
        by_new = walk.by_drift @ np.linalg.inv(walk.to_step[new])
        by_new[:new] = 0.0
        flat = by_new.reshape(size, 6)
        covariance += flat @ news @ flat.T
    field = walk.by_field.reshape(size, -1) * (sizes[parts] * walk.field_stds)
    rows = np.repeat(USED, 6)
    covariance = (covariance + field @ field.T)[np.ix_(rows, rows)]
    return covariance, walk.pairs.by_unknowns.reshape(size, -1)[rows]


def test_likelihood_and_unknowns_are_those_of_the_dense_covariance(walk):
    """The restricted likelihood integrates over the unknowns: a normal prior of endless width."""
    errors = walk.pairs.errors[USED].ravel()
    deviances = []
    for logarithms in (LOGARITHMS, LOGARITHMS + np.linspace(-0.5, 0.5, 8)):
        covariance, columns = dense(walk, logarithms)
        solved = solved_walk(walk, logarithms)
        found, inverse = solved.fit, np.linalg.inv(covariance)
        by_unknowns = np.linalg.inv(columns.T @ inverse @ columns)
        best = by_unknowns @ columns.T @ inverse @ errors
        np.testing.assert_allclose(found.unknowns[:12], best, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(found.covariance[:12, :12], by_unknowns, rtol=1e-5, atol=1e-14)
        left_over = errors - columns @ best
        assert solved.squares == pytest.approx(left_over @ inverse @ left_over, rel=1e-6)
        normal = multivariate_normal(np.zeros(len(errors)), covariance)
        density = normal.logpdf(left_over)
        deviance = -2.0 * density - np.linalg.slogdet(by_unknowns)[1]
        deviances.append(found.deviance - deviance)
    # Constants differ, by the choice of the unknowns' units.
    assert deviances[0] == pytest.approx(deviances[1], abs=1e-6)


def test_the_drift_goes_on_through_views_that_are_not_used(walk):
    """A walk is at the mean of its neighbours where nothing is measured, seen in one frame."""
    found = solved_walk(walk, LOGARITHMS)
    assert (found.drift[0] == 0.0).all()
    view = int(np.flatnonzero(~USED)[1])
    before, here, after = found.drift[view - 1 : view + 2]
    stds = walk.drift_stds(LOGARITHMS)
    precisions = [walk.to_step[k].T @ np.diag(stds**-2) @ walk.to_step[k] for k in (view, view + 1)]
    expected = np.linalg.solve(sum(precisions), precisions[0] @ before + precisions[1] @ after)
    np.testing.assert_allclose(here, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("drifts", [True, False])
def test_slopes_agree_with_differences_of_the_likelihood(walk, drifts):
    """Also through views that are not used."""
    walk = walk._replace(drifts=drifts)
    logarithms = LOGARITHMS if drifts else LOGARITHMS[:6]
    slopes = approx_fprime(logarithms, lambda place: solved_walk(walk, place).deviance, 1e-6)
    np.testing.assert_allclose(deviance_slopes(solved_walk(walk, logarithms)), slopes, atol=1e-3)


def test_the_likeliest_sizes_are_at_a_maximum(walk):
    priors = LogNormalPriors(np.eye(8), np.log(np.ones(8)), np.full(8, 3.0))
    best = likeliest_walk(walk, np.zeros(8), priors)

    def deviance(logarithms):
        return solved_walk(walk, logarithms).deviance + np.sum((logarithms / 3.0) ** 2)

    lowest = deviance(best.logarithms)
    for step in 0.05 * np.vstack([np.eye(8), -np.eye(8)]):
        assert deviance(best.logarithms + step) > lowest - 2e-3
    assert np.isfinite(walk_log_evidence(walk, best, priors))


def test_a_drift_that_is_lost_in_rounding_errors_has_no_evidence(walk, monkeypatch):
    """Millions of metres from the poses, a sum of squares comes out negative."""

    def lost(*arguments):
        return solved_walk(*arguments)._replace(squares=-1.0)

    monkeypatch.setattr(sys.modules[likeliest_walk.__module__], "solved_walk", lost)
    priors = LogNormalPriors(np.eye(8), np.log(np.ones(8)), np.full(8, 3.0))
    with pytest.raises(np.linalg.LinAlgError, match="lost in rounding errors, because its poses"):
        likeliest_walk(walk, np.zeros(8), priors)
