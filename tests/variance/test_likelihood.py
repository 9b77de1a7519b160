import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_world import (
    CAMERA,
    GROUP,
    GROUP_FIXED,
    MOUNT,
    OTHERS,
    SHARED,
    TRUTH,
    VIEWS,
    drawn,
    linearised,
    moved,
    with_held,
)
from scipy.stats import multivariate_normal

from smartview_jax.variance.fisher_scoring import fisher_information
from smartview_jax.variance.likelihood import (
    deviance,
    gradient,
    marginalise,
    posterior_mode_step,
)


def textbook(world, observed, sizes):
    """Patterson and Thompson's formula on dense matrices, the likelihood itself by SciPy."""
    information, design = world[:2]
    deviations = np.concatenate([np.asarray(sizes.field)[GROUP[GROUP >= 0]]])
    each = np.tile(np.repeat([sizes.translation, sizes.rotation], 3), VIEWS)
    fixed, random = design[:, GROUP_FIXED], design[:, ~GROUP_FIXED]
    spread = np.concatenate([deviations, each])
    V = float(sizes.pixel) ** 2 * np.linalg.inv(information) + (random * spread**2) @ random.T
    inverse = np.linalg.inv(V)
    found = np.linalg.solve(fixed.T @ inverse @ fixed, fixed.T @ inverse @ observed)
    density = multivariate_normal.logpdf(observed, fixed @ found, V)
    return -2.0 * density + np.linalg.slogdet(fixed.T @ inverse @ fixed)[1], found


def test_differences_are_those_of_the_textbook(world):
    observed = drawn(world, 1)
    views = linearised(world, observed)
    base, expected = deviance(views, TRUTH), textbook(world, observed, TRUTH)[0]
    for sizes in OTHERS:
        found = deviance(views, sizes) - base
        np.testing.assert_allclose(found, textbook(world, observed, sizes)[0] - expected, rtol=1e-8)


def test_the_best_step_is_generalised_least_squares(world):
    observed = drawn(world, 2)
    step = posterior_mode_step(linearised(world, observed), TRUTH)
    expected = textbook(world, observed, TRUTH)[1]
    np.testing.assert_allclose(step.shared[: CAMERA + MOUNT], expected, rtol=1e-8)


def test_it_does_not_matter_where_the_chain_is_linearised(world):
    observed = drawn(world, 3)
    at = np.random.default_rng(4).normal(size=SHARED + 6 * VIEWS)
    here, there = linearised(world, observed), linearised(world, observed, at)
    for sizes in (TRUTH, *OTHERS):
        np.testing.assert_allclose(deviance(here, sizes), deviance(there, sizes), rtol=1e-9)
    steps = posterior_mode_step(here, TRUTH), posterior_mode_step(there, TRUTH)
    np.testing.assert_allclose(steps[0].shared, at[:SHARED] + steps[1].shared, atol=1e-8)


@pytest.mark.parametrize("held", [False, True])
def test_its_gradient_is_that_of_differences(world, held):
    """Away from where the prior means are, with some of the views' own numbers held."""
    at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
    views = linearised(world, drawn(world, 5), at)
    if held:
        free = jnp.asarray(np.random.default_rng(9).random((VIEWS, 6)) < 0.7)
        views = with_held(views, free)
    sizes = OTHERS[0]
    value = jax.jit(lambda s: deviance(views, s))
    slopes = jax.jit(jax.grad(value))(sizes)
    for k, slope in enumerate(slopes.vector):
        ahead, behind = (value(moved(sizes, k, s)) for s in (1e-5, -1e-5))
        difference = (ahead - behind) / (2e-5 * sizes.vector[k])
        np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_it_is_differentiable_by_the_observations_and_twice_by_the_sizes(world):
    views = linearised(world, drawn(world, 5))
    by_views = jax.jit(jax.grad(lambda v: deviance(v, TRUTH), allow_int=True))
    by_gradient = by_views(views).gradient.shared
    step = jnp.zeros(SHARED).at[1].set(1e-4)
    ahead, behind = (
        deviance(eqx.tree_at(lambda v: v.gradient.shared, views, views.gradient.shared + s), TRUTH)
        for s in (step, -step)
    )
    np.testing.assert_allclose(by_gradient[1], (ahead - behind) / 2e-4, rtol=1e-6)
    slope = jax.jit(jax.grad(lambda s: deviance(views, s)))
    curved = jax.jit(jax.jacfwd(slope))(TRUTH).translation.translation
    ahead, behind = (slope(moved(TRUTH, 1, s)).translation for s in (1e-6, -1e-6))
    expected = (ahead - behind) / (2e-6 * TRUTH.translation)
    np.testing.assert_allclose(curved, expected, rtol=1e-5)


def test_numpy_and_jax_find_the_same(world):
    """NumPy arrays are left to NumPy: a JAX array would be one from a program that was compiled."""
    at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
    free = jnp.asarray(np.random.default_rng(9).random((VIEWS, 6)) < 0.7)
    traced = with_held(linearised(world, drawn(world, 5), at), free)
    host = jax.tree.map(np.asarray, traced)
    for sizes in OTHERS:
        both = []
        for views, size in ((host, jax.tree.map(np.asarray, sizes)), (traced, sizes)):
            marginal = marginalise(views, size)
            found = (
                marginal.deviance,
                marginal.step,
                marginal.shared_covariance,
                gradient(views, size, marginal).vector,
                fisher_information(views, marginal, 2),
            )
            both.append(jax.tree.leaves(found))
        assert not any(isinstance(leaf, jax.Array) for leaf in both[0])
        for mine, other in zip(*both, strict=True):
            np.testing.assert_allclose(mine, other, rtol=1e-8, atol=1e-11)


def test_held_parameters_are_the_limit_of_a_narrow_prior(world):
    """Away from where the prior means are, so that the parameters have to move there."""
    at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
    views = jax.tree.map(np.asarray, linearised(world, drawn(world, 5), at))
    fewer = views.with_held(GROUP == 1)
    for sizes in (TRUTH, *OTHERS):
        narrow = sizes._replace(field=sizes.field.at[1].set(1e-5))
        found, expected = marginalise(fewer, sizes), marginalise(views, narrow)
        np.testing.assert_allclose(found.deviance, expected.deviance, rtol=1e-6)
        np.testing.assert_allclose(
            found.step.shared, expected.step.shared[GROUP != 1], rtol=1e-6, atol=1e-7
        )
