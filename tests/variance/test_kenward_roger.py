import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from linear_world import (
    CAMERA,
    GROUP,
    MOUNT,
    SHARED,
    TRUTH,
    VIEWS,
    drawn,
    linearised,
    some_held,
    with_held,
)

from smartview_jax.variance.fisher_scoring import maximise
from smartview_jax.variance.kenward_roger import p_value, small_sample_correction
from smartview_jax.variance.likelihood import marginalise
from smartview_jax.variance.standard_deviations import StandardDeviations

FITTED = np.flatnonzero(GROUP < 0)


def found_and_doubted(views, active):
    found = maximise(views, TRUTH, active)
    at = marginalise(views, found.sigmas)
    return at.step.shared, at.shared_covariance, small_sample_correction(views, found)


def of_fitted(step, covariance, doubted):
    doubted = doubted.subset(FITTED)
    whole = np.asarray(covariance)[np.ix_(FITTED, FITTED)] + doubted.added_covariance
    return np.asarray(step)[FITTED], whole, doubted


def effects(world, seed):
    """What `sample` drew first."""
    return 2.0 * np.random.default_rng(seed).normal(size=SHARED)[FITTED]


def test_where_pixels_err_alone_it_is_the_textbook_of_regression(world):
    """Student's t and Fisher's F on all statistics less what is fitted."""
    views = linearised(world, drawn(world, 8))
    _, whole, doubted = of_fitted(*found_and_doubted(views, np.zeros(4, dtype=bool)))
    expected = float(views.statistic_count) - len(FITTED)
    np.testing.assert_allclose(doubted.degrees_of_freedom, expected, rtol=1e-3)
    assert float(doubted.relative_std[0]) == pytest.approx(np.sqrt(0.5 / expected), rel=1e-3)
    assert np.abs(doubted.added_covariance).max() < 1e-12
    offset = 0.7 * np.sqrt(np.diagonal(whole))
    square = offset @ np.linalg.solve(whole, offset)
    count = len(FITTED)
    chance = scipy.stats.f.sf(square / count, count, expected)
    assert p_value(offset, whole, doubted) == pytest.approx(chance, rel=1e-3)
    assert p_value(offset, whole) == pytest.approx(scipy.stats.chi2.sf(square, count), rel=1e-9)


def test_one_number_alone_has_students_chance(world):
    views = linearised(world, drawn(world, 8))
    _, whole, doubted = of_fitted(*found_and_doubted(views, np.ones(4, dtype=bool)))
    for k in (0, CAMERA, CAMERA + MOUNT - 1):
        std, only = np.sqrt(whole[k, k]), np.array([k])
        chance = p_value(np.array([2.0 * std]), whole[k : k + 1, k : k + 1], doubted.subset(only))
        expected = 2.0 * scipy.stats.t.sf(2.0, doubted.degrees_of_freedom[k])
        assert chance == pytest.approx(expected, rel=1e-6)


def test_a_size_at_its_least_moves_nothing(world):
    """Pixels that scatter less than within a view; a robot that does not err."""
    views = linearised(world, drawn(world, 6))
    views = eqx.tree_at(lambda v: v.white_sigma, views, 20.0 * TRUTH.pixel)
    _, whole, doubted = of_fitted(*found_and_doubted(views, np.zeros(4, dtype=bool)))
    assert (doubted.degrees_of_freedom > 1e6).all()
    offset = np.sqrt(np.diagonal(whole))
    assert p_value(offset, whole, doubted) == pytest.approx(p_value(offset, whole), rel=1e-4)


def test_derivatives_are_those_of_automatic_differentiation(world):
    """Away from where the prior means are, with a known prior and some of the views' own held."""
    at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
    views = with_held(linearised(world, drawn(world, 5), at), some_held())
    known_weight = np.zeros(SHARED)
    known_weight[1] = 0.4
    views = eqx.tree_at(lambda v: v.known_weight, views, known_weight)
    found = maximise(views, TRUTH, np.ones(4, dtype=bool))

    def by_log_sigma(logarithms):
        marginal = marginalise(views, StandardDeviations.from_vector(jnp.exp(logarithms)))
        return marginal.step.shared, marginal.shared_covariance

    by_step, by_covariance = jax.jit(jax.jacfwd(by_log_sigma))(np.log(found.sigmas.vector))
    doubted = small_sample_correction(views, found)
    # Lower bounds are negligible here: the logarithms of excess and deviation are equal.
    expected = jnp.moveaxis(by_covariance, -1, 0)
    np.testing.assert_allclose(doubted.covariance_derivatives, expected, rtol=1e-7, atol=1e-11)
    expected = 2.0 * by_step @ doubted.log_excess_covariance @ by_step.T
    np.testing.assert_allclose(doubted.added_covariance, expected, rtol=1e-7, atol=1e-11)


def test_stated_chances_are_true(world):
    """Fields of two and of three draws: taken as known, their sizes promise too much."""
    stated, without = [], []
    for seed in range(500):
        views = linearised(world, drawn(world, seed))
        step, whole, doubted = of_fitted(*found_and_doubted(views, np.ones(4, dtype=bool)))
        offset = step - effects(world, seed)
        stated.append(p_value(offset, whole, doubted))
        without.append(p_value(offset, whole - doubted.added_covariance))
    assert scipy.stats.kstest(stated, "uniform").pvalue > 0.01
    assert scipy.stats.kstest(without, "uniform").pvalue < 0.01
    assert 0.03 <= np.mean(np.array(stated) < 0.05) <= 0.07
