import jax
import jax.numpy as jnp
import numpy as np
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
    some_held,
    with_held,
)
from scipy.stats import multivariate_normal

from smartview_jax.variance.fisher_information import fisher_information
from smartview_jax.variance.likelihood import deviance, gradient, marginalise, posterior_mode_step
from smartview_jax.variance.linearised_views import kinds_of


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


def deviance_of(views, sizes):
    """By NumPy: a JAX array would be compiled for, operation by operation."""
    return marginalise(views, sizes).deviance


def slopes_of(views, sizes):
    """The derivatives of the deviance in closed form."""
    return gradient(views, sizes, marginalise(views, sizes)).vector


def views_with_some_held(world):
    """Away from where the prior means are."""
    at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
    return with_held(linearised(world, drawn(world, 5), at), some_held())


def test_differences_are_those_of_the_textbook(world):
    observed = drawn(world, 1)
    views = linearised(world, observed)
    base, expected = deviance_of(views, TRUTH), textbook(world, observed, TRUTH)[0]
    for sizes in OTHERS:
        found = deviance_of(views, sizes) - base
        np.testing.assert_allclose(found, textbook(world, observed, sizes)[0] - expected, rtol=1e-8)


def test_the_best_step_is_generalised_least_squares(world):
    observed = drawn(world, 2)
    step = posterior_mode_step(linearised(world, observed), TRUTH)
    expected = textbook(world, observed, TRUTH)[1]
    np.testing.assert_allclose(step.shared[: CAMERA + MOUNT], expected, rtol=1e-8)


def test_the_likelihood_is_alike_wherever_the_chain_is_linearised(world):
    observed = drawn(world, 3)
    at = np.random.default_rng(4).normal(size=SHARED + 6 * VIEWS)
    here, there = linearised(world, observed), linearised(world, observed, at)
    for sizes in (TRUTH, *OTHERS):
        np.testing.assert_allclose(deviance_of(here, sizes), deviance_of(there, sizes), rtol=1e-9)
    steps = posterior_mode_step(here, TRUTH), posterior_mode_step(there, TRUTH)
    np.testing.assert_allclose(steps[0].shared, at[:SHARED] + steps[1].shared, atol=1e-8)


def test_the_gradient_agrees_with_differences(world):
    views, sizes = views_with_some_held(world), OTHERS[0]
    for k, slope in enumerate(slopes_of(views, sizes)):
        ahead, behind = (deviance_of(views, moved(sizes, k, s)) for s in (1e-5, -1e-5))
        difference = (ahead - behind) / (2e-5 * sizes.vector[k])
        np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_the_likelihood_is_differentiable_by_the_observations_and_twice_by_the_sizes(world):
    views = views_with_some_held(world)
    on_device = jax.tree.map(jnp.asarray, views)

    @jax.jit
    def derivatives(views, sizes):
        by_views = jax.grad(deviance, allow_int=True)(views, sizes)

        def slopes(sizes):
            found = jax.grad(deviance, argnums=1)(views, sizes)
            return found, found

        curved, by_sizes = jax.jacfwd(slopes, has_aux=True)(sizes)
        return by_views.gradient.shared, by_sizes.vector, curved.translation.translation

    by_views, by_sizes, curved = derivatives(on_device, jax.tree.map(jnp.asarray, TRUTH))
    step = np.zeros(SHARED)
    step[1] = 1e-4
    ahead, behind = (
        deviance_of(views._replace(gradient=views.gradient._replace(shared=moved_shared)), TRUTH)
        for moved_shared in (views.gradient.shared + step, views.gradient.shared - step)
    )
    np.testing.assert_allclose(by_views[1], (ahead - behind) / 2e-4, rtol=1e-6)
    np.testing.assert_allclose(by_sizes, slopes_of(views, TRUTH), rtol=1e-8)
    ahead, behind = (slopes_of(views, moved(TRUTH, 1, s))[1] for s in (1e-6, -1e-6))
    expected = (ahead - behind) / (2e-6 * TRUTH.translation)
    np.testing.assert_allclose(curved, expected, rtol=1e-5)


def test_numpy_and_jax_find_the_same(world):
    """NumPy arrays are left to NumPy: a JAX array would be one from a program that was compiled."""

    def everything(views, sizes):
        marginal = marginalise(views, sizes)
        found = (
            marginal.deviance,
            marginal.step,
            marginal.shared_covariance,
            gradient(views, sizes, marginal).vector,
            fisher_information(views, marginal, kinds_of(views, 2)),
        )
        return jax.tree.leaves(found)

    host, compiled = views_with_some_held(world), jax.jit(everything)
    for sizes in OTHERS:
        found = everything(host, sizes)
        assert not any(isinstance(leaf, jax.Array) for leaf in found)
        for mine, other in zip(found, compiled(host, sizes), strict=True):
            np.testing.assert_allclose(mine, other, rtol=1e-8, atol=1e-11)


def test_held_parameters_are_the_limit_of_a_narrow_prior(world):
    """Away from where the prior means are, so that the parameters have to move there."""
    at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
    views = linearised(world, drawn(world, 5), at)
    fewer = views.with_held(GROUP == 1)
    for sizes in (TRUTH, *OTHERS):
        narrow = sizes._replace(field=np.array([sizes.field[0], 1e-5]))
        found, expected = marginalise(fewer, sizes), marginalise(views, narrow)
        np.testing.assert_allclose(found.deviance, expected.deviance, rtol=1e-6)
        np.testing.assert_allclose(
            found.step.shared, expected.step.shared[GROUP != 1], rtol=1e-6, atol=1e-7
        )
