import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from smartview_jax.joint.likelihood import (
    LinearisedViews,
    Sizes,
    best_step,
    deviance,
    likeliest,
)
from smartview_jax.joint.parameters import Step
from smartview_jax.joint.schur import BlockArrow

CAMERA, MOUNT, FIELD, VIEWS = 3, 4, (2, 3), 30
SHARED = CAMERA + MOUNT + sum(FIELD)


@pytest.fixture(scope="module")
def world():
    """A linear world: every view's statistics, their information, and how they came about."""
    rng = np.random.default_rng(0)
    size = CAMERA + 6 * VIEWS
    # An observed value of the camera's numbers and of each view's six, with correlated errors.
    roots = [rng.normal(size=(9, 6 + CAMERA)) for _ in range(VIEWS)]
    information = np.zeros((size, size))
    for k, root in enumerate(roots):
        where = np.r_[:CAMERA, CAMERA + 6 * k : CAMERA + 6 * k + 6]
        information[np.ix_(where, where)] += root.T @ root
    design = np.zeros((size, SHARED + 6 * VIEWS))
    design[:CAMERA, :CAMERA] = np.eye(CAMERA)
    design[CAMERA:, CAMERA:SHARED] = rng.normal(size=(6 * VIEWS, SHARED - CAMERA))
    design[CAMERA:, SHARED:] = np.eye(6 * VIEWS)
    return information, design


TRUTH = Sizes(*map(jnp.asarray, (0.7, 0.4, 0.2)), jnp.array([0.5, 0.3]))
GROUP = np.repeat([-1, 0, 1], [CAMERA + MOUNT, *FIELD])


def drawn(world, seed):
    """Statistics drawn from the model."""
    information, design = world
    rng = np.random.default_rng(seed)
    effects = 2.0 * rng.normal(size=SHARED)
    for k, deviation in enumerate(np.asarray(TRUTH.field)):
        effects[k == GROUP] = deviation * rng.normal(size=FIELD[k])
    each = np.repeat([TRUTH.translation, TRUTH.rotation], 3)
    own = each * rng.normal(size=(VIEWS, 6))
    noise = np.linalg.cholesky(np.linalg.inv(information)) @ rng.normal(size=len(information))
    return design @ np.concatenate([effects, own.ravel()]) + float(TRUTH.pixel) * noise


def linearised(world, observed, at=None):
    """What the library is given: normal equations at a point of all parameters."""
    information, design = world
    at = np.zeros(design.shape[1]) if at is None else at
    residual = observed - design @ at
    whole = design.T @ information @ design
    slope = -design.T @ information @ residual
    own = whole[SHARED:, SHARED:].reshape(VIEWS, 6, VIEWS, 6)[range(VIEWS), :, range(VIEWS)]
    off = whole[SHARED:, SHARED:].copy()
    for k in range(VIEWS):
        off[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = 0.0
    assert np.abs(off).max() < 1e-12
    return LinearisedViews(
        matrix=BlockArrow(
            jnp.asarray(whole[:SHARED, :SHARED]),
            jnp.asarray(whole[SHARED:, :SHARED].reshape(VIEWS, 6, SHARED)),
            jnp.asarray(own),
        ),
        gradient=Step(jnp.asarray(slope[:SHARED]), jnp.asarray(slope[SHARED:].reshape(VIEWS, 6))),
        between=jnp.asarray(residual @ information @ residual),
        off_mean=Step(jnp.asarray(at[:SHARED]), jnp.asarray(at[SHARED:].reshape(VIEWS, 6))),
        known_weight=jnp.zeros(SHARED),
        group=jnp.asarray(GROUP),
        own_free=jnp.ones((VIEWS, 6), dtype=bool),
        count=jnp.asarray(float(len(observed))),
        white_sigma=jnp.asarray(1e-6),
    )


def textbook(world, observed, sizes):
    """Patterson and Thompson's formula on dense matrices, the likelihood itself by SciPy."""
    information, design = world
    deviations = np.concatenate([np.asarray(sizes.field)[GROUP[GROUP >= 0]]])
    each = np.tile(np.repeat([sizes.translation, sizes.rotation], 3), VIEWS)
    fixed, random = design[:, GROUP_FIXED], design[:, ~GROUP_FIXED]
    spread = np.concatenate([deviations, each])
    V = float(sizes.pixel) ** 2 * np.linalg.inv(information) + (random * spread**2) @ random.T
    inverse = np.linalg.inv(V)
    found = np.linalg.solve(fixed.T @ inverse @ fixed, fixed.T @ inverse @ observed)
    density = multivariate_normal.logpdf(observed, fixed @ found, V)
    return -2.0 * density + np.linalg.slogdet(fixed.T @ inverse @ fixed)[1], found


GROUP_FIXED = np.concatenate([GROUP < 0, np.zeros(6 * VIEWS, dtype=bool)])

OTHERS = (
    Sizes(*map(jnp.asarray, (0.3, 0.9, 0.05)), jnp.array([2.0, 0.01])),
    Sizes(*map(jnp.asarray, (2.0, 0.1, 0.6)), jnp.array([0.1, 1.0])),
)


def test_differences_are_those_of_the_textbook(world):
    observed = drawn(world, 1)
    views = linearised(world, observed)
    base, expected = deviance(views, TRUTH), textbook(world, observed, TRUTH)[0]
    for sizes in OTHERS:
        found = deviance(views, sizes) - base
        np.testing.assert_allclose(found, textbook(world, observed, sizes)[0] - expected, rtol=1e-8)


def test_the_best_step_is_generalised_least_squares(world):
    observed = drawn(world, 2)
    step = best_step(linearised(world, observed), TRUTH)
    expected = textbook(world, observed, TRUTH)[1]
    np.testing.assert_allclose(step.shared[: CAMERA + MOUNT], expected, rtol=1e-8)


def test_it_does_not_matter_where_the_chain_is_linearised(world):
    observed = drawn(world, 3)
    at = np.random.default_rng(4).normal(size=SHARED + 6 * VIEWS)
    here, there = linearised(world, observed), linearised(world, observed, at)
    for sizes in (TRUTH, *OTHERS):
        np.testing.assert_allclose(deviance(here, sizes), deviance(there, sizes), rtol=1e-9)
    steps = best_step(here, TRUTH), best_step(there, TRUTH)
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
    slopes = jax.grad(lambda s: deviance(views, s))(sizes)
    for k, slope in enumerate(slopes.numbers):
        ahead, behind = (deviance(views, moved(sizes, k, s)) for s in (1e-5, -1e-5))
        difference = (ahead - behind) / (2e-5 * sizes.numbers[k])
        np.testing.assert_allclose(slope, difference, rtol=1e-5)


def moved(sizes, k, share):
    """One of the sizes larger by a share of it."""
    numbers = sizes.numbers.at[k].multiply(1.0 + share)
    return Sizes(numbers[0], numbers[1], numbers[2], numbers[3:])


def with_held(views, free):
    """What `JointProblem` makes of corrections that are held: no columns."""
    own = jnp.where(free[..., None] & free[:, None], views.matrix.own, 0.0)
    border = jnp.where(free[..., None], views.matrix.border, 0.0)
    gradient = jnp.where(free, views.gradient.corrections, 0.0)
    return eqx.tree_at(
        lambda v: (v.matrix.own, v.matrix.border, v.gradient.corrections, v.own_free),
        views,
        (own, border, gradient, free),
    )


def test_it_is_differentiable_by_the_observations_and_twice_by_the_sizes(world):
    views = linearised(world, drawn(world, 5))
    by_gradient = jax.grad(lambda v: deviance(v, TRUTH), allow_int=True)(views).gradient.shared
    step = jnp.zeros(SHARED).at[1].set(1e-4)
    ahead, behind = (
        deviance(eqx.tree_at(lambda v: v.gradient.shared, views, views.gradient.shared + s), TRUTH)
        for s in (step, -step)
    )
    np.testing.assert_allclose(by_gradient[1], (ahead - behind) / 2e-4, rtol=1e-6)
    slope = jax.grad(lambda s: deviance(views, s))
    curved = jax.jacfwd(slope)(TRUTH).translation.translation
    ahead, behind = (slope(moved(TRUTH, 1, s)).translation for s in (1e-6, -1e-6))
    expected = (ahead - behind) / (2e-6 * TRUTH.translation)
    np.testing.assert_allclose(curved, expected, rtol=1e-5)


@pytest.fixture(scope="module")
def search():
    return jax.jit(likeliest)


def test_the_sizes_found_are_true_on_average(world, search):
    start = Sizes(*map(jnp.asarray, (0.1, 0.1, 0.1)), jnp.array([0.1, 0.1]))
    active = jnp.ones(4, dtype=bool)
    found = [
        search(linearised(world, drawn(world, seed)), start, active)[0].numbers
        for seed in range(10, 40)
    ]
    variances = np.mean(np.square(found), axis=0)
    # The restricted likelihood's variances are unbiased; the field's rest on 2 and 3 draws each.
    np.testing.assert_allclose(variances[:3], np.square(TRUTH.numbers[:3]), rtol=0.12)
    np.testing.assert_allclose(variances[3:], np.square(TRUTH.numbers[3:]), rtol=0.8)


def test_the_search_ends_at_an_optimum(world, search):
    views = linearised(world, drawn(world, 6))
    starts = [jax.tree.map(lambda size, f=factor: f * size, TRUTH) for factor in (1.0, 2.5, 6.0)]
    active = jnp.ones(4, dtype=bool)
    values = [float(search(views, start, active)[1]) for start in starts]
    np.testing.assert_allclose(values, min(values), atol=1e-2)
    best = search(views, TRUTH, active)[0].numbers
    for k in range(len(best)):
        for factor in (0.97, 1.03):
            other = best.at[k].multiply(factor)
            sizes = Sizes(other[0], other[1], other[2], other[3:])
            assert float(deviance(views, sizes)) > values[0]


def test_a_group_that_is_switched_off_stays_at_zero(world, search):
    views = linearised(world, drawn(world, 7))
    found, value = search(views, TRUTH, jnp.array([True, True, True, False]))
    assert float(found.field[1]) < 1e-8
    assert float(value) > float(search(views, TRUTH, jnp.ones(4, dtype=bool))[1])
