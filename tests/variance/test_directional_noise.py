import jax
import numpy as np
import pytest
from linear_world import CAMERA, GROUP, MOUNT, SHARED, TRUTH, VIEWS, linearised
from scipy.linalg import block_diag, expm
from scipy.optimize import fsolve, minimize
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from smartview_jax.runtime.modules import with_fields
from smartview_jax.variance.directional_search import estimate_directions
from smartview_jax.variance.fisher_scoring import LikelihoodMaximum
from smartview_jax.variance.kenward_roger import small_sample_correction
from smartview_jax.variance.likelihood import marginalise
from smartview_jax.variance.model_average import between_directions_covariance

FITTED = np.flatnonzero(GROUP < 0)
TURNS = Rotation.random(VIEWS, random_state=5).as_matrix()
"""Rotations from the base to the tool."""

AXES = np.diag([0.2, 0.2, 2.0, 0.1, 0.1, 0.5]) ** 2
LEVER = np.array([0.0, 1.5, -1.0, 0.6, 0.0, 0.3])
JOINT = np.outer(LEVER, LEVER) + np.diag([0.1, 0.1, 0.1, 0.05, 0.05, 0.05]) ** 2
"""Covariances of errors in three directions, and of a robot with one bad joint."""


def in_base(covariance):
    """The covariance at the tool of every view, of errors that follow the base."""
    both = np.stack([block_diag(turn, turn) for turn in TURNS])
    return both @ covariance @ both.swapaxes(1, 2)


def drawn(world, seed, covariances):
    """Statistics of views whose poses err by these covariances."""
    rng = np.random.default_rng(seed)
    effects = 2.0 * rng.normal(size=SHARED)
    for k, deviation in enumerate(np.asarray(TRUTH.field)):
        effects[k == GROUP] = deviation * rng.normal(size=np.sum(k == GROUP))
    own = [rng.multivariate_normal(np.zeros(6), each) for each in covariances]
    noise = world.noise_root @ rng.normal(size=len(world.noise_root))
    return world.design @ np.concatenate([effects, *own]) + float(TRUTH.pixel) * noise


def textbook(world, observed, covariances):
    """The deviance on dense matrices by SciPy, generalised least squares, and its covariance."""
    information, design = world[:2]
    fixed, field = design[:, :SHARED][:, GROUP < 0], design[:, :SHARED][:, GROUP >= 0]
    spread = np.asarray(TRUTH.field)[GROUP[GROUP >= 0]]
    own = design[:, SHARED:]
    V = float(TRUTH.pixel) ** 2 * np.linalg.inv(information) + (field * spread**2) @ field.T
    V = V + own @ block_diag(*covariances) @ own.T
    inverse = np.linalg.inv(V)
    precision = fixed.T @ inverse @ fixed
    found = np.linalg.solve(precision, fixed.T @ inverse @ observed)
    density = multivariate_normal.logpdf(observed, fixed @ found, V)
    return -2.0 * density + np.linalg.slogdet(precision)[1], found, np.linalg.inv(precision)


def estimated(world, seed, covariances):
    observed = drawn(world, seed, covariances)
    views = jax.tree.map(np.asarray, linearised(world, observed))
    noise = estimate_directions(views, TRUTH, TURNS)
    assert noise is not None
    return observed, views, noise


def test_the_axes_of_the_base_are_found_where_scipy_finds_them(world):
    observed, _, noise = estimated(world, 1, in_base(AXES))
    assert noise.probabilities["base axes"] > 0.9

    def deviance(x):
        # The entries' prior: each logarithm of a variance less their mean has the deviation 1.
        of_axes = x.reshape(2, 3) - x.reshape(2, 3).mean(axis=1, keepdims=True)
        return textbook(world, observed, in_base(np.diag(np.exp(x))))[0] + np.sum(of_axes**2)

    best = minimize(deviance, np.log(np.diagonal(AXES)), options={"gtol": 1e-3})
    found = noise.covariances["base axes"]
    expected = in_base(np.diag(np.exp(best.x)))
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=1e-3 * np.abs(expected).max())


def entries(covariance):
    """H of a covariance, whose levels make the traces of translation and of rotation zero."""

    def at(levels):
        units = np.exp(-np.repeat(levels, 3))
        values, vectors = np.linalg.eigh(covariance * np.outer(units, units))
        return (vectors * np.log(values)) @ vectors.T

    levels = fsolve(
        lambda x: np.diagonal(at(x)).reshape(2, 3).sum(axis=1),
        0.25 * np.log(np.diagonal(covariance)).reshape(2, 3).mean(axis=1),
    )
    return at(levels)


def test_a_bad_joint_is_an_ellipsoid_at_the_top_of_the_posterior(world):
    observed, _, noise = estimated(world, 2, in_base(JOINT))
    assert noise.probabilities["base ellipsoid"] > 0.9
    to_tool = block_diag(TURNS[0], TURNS[0])
    found = to_tool.T @ noise.covariances["base ellipsoid"][0] @ to_tool
    root = np.linalg.cholesky(found)

    def posterior(change):
        covariance = root @ expm(change) @ root.T
        return textbook(world, observed, in_base(covariance))[0] + np.sum(entries(covariance) ** 2)

    best, rng = posterior(np.zeros((6, 6))), np.random.default_rng(0)
    for _ in range(6):
        change = rng.normal(size=(6, 6))
        change = 0.1 * (change + change.T)
        ahead, behind = posterior(change) - best, posterior(-change) - best
        assert min(ahead, behind) > 0.0
        # At a maximum both sides fall alike.
        assert abs(ahead - behind) < 0.5 * (ahead + behind)


def test_equal_errors_stay_equal(world):
    equal = np.tile(np.diag(np.repeat([0.4, 0.2], 3) ** 2), (VIEWS, 1, 1))
    probabilities = []
    for seed in range(8):
        views = jax.tree.map(np.asarray, linearised(world, drawn(world, seed, equal)))
        noise = estimate_directions(views, TRUTH, TURNS)
        probabilities.append(1.0 if noise is None else noise.probabilities.get("equal", 0.0))
    assert np.median(probabilities) > 0.8
    assert min(probabilities) > 0.5


def test_the_roots_give_the_averaged_covariance(world):
    _, _, noise = estimated(world, 3, in_base(AXES))
    sizes = np.repeat([noise.translation, noise.rotation], 3)
    averaged = sum(p * noise.covariances[name] for name, p in noise.probabilities.items())
    np.testing.assert_allclose(
        (noise.roots * sizes**2) @ noise.roots.swapaxes(1, 2), averaged, rtol=1e-9, atol=1e-12
    )


def test_sizes_are_means_over_axes_where_rotations_follow_translations(world):
    """The motions of a bad joint are drawn, and the sizes of their rotations taken alone."""
    _, _, noise = estimated(world, 2, in_base(JOINT))
    sizes = np.array([2.0 * noise.translation, 0.5 * noise.rotation])
    resized = noise.with_sizes(sizes)
    draws = np.random.default_rng(0).normal(size=(20_000, 1, 6)) * np.repeat(sizes, 3)
    twists = np.einsum("vij,nvj->nvi", noise.roots, np.broadcast_to(draws, (20_000, VIEWS, 6)))
    means = np.sqrt(np.mean(twists.reshape(-1, 2, 3) ** 2, axis=(0, 2)))
    np.testing.assert_allclose([resized.translation, resized.rotation], means, rtol=0.02)
    # Independent parameters of these sizes are the same errors.
    for view in range(VIEWS):
        expected = np.cov(twists[:, view], rowvar=False)
        np.testing.assert_allclose(
            resized.covariance[view], expected, rtol=0.1, atol=0.03 * np.abs(expected).max()
        )


def test_other_poses_err_along_the_same_axes(world):
    """Of the base, in whose frame the errors were drawn; at the views themselves as estimated."""
    *_, noise = estimated(world, 3, in_base(AXES))
    anywhere = noise.at_any_pose(TURNS)
    np.testing.assert_allclose(anywhere.covariances(TURNS), noise.covariance, rtol=1e-6)
    others = Rotation.random(5, random_state=8).as_matrix()
    both = np.stack([block_diag(turn, turn) for turn in others])
    in_base_again = both.swapaxes(1, 2) @ anywhere.covariances(others) @ both
    first = block_diag(TURNS[0], TURNS[0])
    common = first.T @ noise.covariance[0] @ first
    np.testing.assert_allclose(
        in_base_again, np.broadcast_to(common, (5, 6, 6)), rtol=1e-6, atol=1e-9
    )


def test_hypotheses_grow_with_their_average(world):
    """And their slopes, which are as large relative to the covariance as before."""
    _, _, noise = estimated(world, 2, in_base(JOINT))
    resized = noise.with_sizes(np.array([2.0 * noise.translation, 0.5 * noise.rotation]))
    averaged = sum(p * resized.covariances[name] for name, p in noise.probabilities.items())
    np.testing.assert_allclose(averaged, resized.covariance, rtol=1e-9, atol=1e-12)
    before, after = (
        np.linalg.eigvalsh(inverse @ each.slopes @ inverse.swapaxes(1, 2))
        for each in (noise, resized)
        for inverse in [np.linalg.inv(np.linalg.cholesky(each.covariance))]
    )
    np.testing.assert_allclose(after, before, rtol=1e-6, atol=1e-9)


def test_the_worst_direction_is_the_one_in_which_draws_scatter_most(world):
    _, _, noise = estimated(world, 1, in_base(AXES))
    ways = np.random.default_rng(0).normal(size=(2000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    for part, found in zip((slice(0, 3), slice(3, 6)), noise.worst, strict=True):
        along = np.einsum("wi,vij,wj->vw", ways, noise.covariance[:, part, part], ways)
        assert found == pytest.approx(np.sqrt(along.max(axis=1).mean()), rel=0.01)


def own_axes(views, noise):
    """The views along the axes of the noise, with the sizes there."""
    sizes = TRUTH._replace(
        translation=np.array(noise.translation), rotation=np.array(noise.rotation)
    )
    return views.in_own_axes(noise.roots), sizes


def test_the_estimate_along_these_axes_is_generalised_least_squares(world):
    observed, views, noise = estimated(world, 4, in_base(AXES))
    whole, sizes = own_axes(views, noise)
    averaged = sum(p * noise.covariances[name] for name, p in noise.probabilities.items())
    step = marginalise(whole, sizes).step.shared[: CAMERA + MOUNT]
    np.testing.assert_allclose(step, textbook(world, observed, averaged)[1], rtol=1e-7)


def test_uncertain_directions_widen_the_covariance_as_differences_do(world):
    observed, views, noise = estimated(world, 6, in_base(AXES))
    whole, sizes = own_axes(views, noise)
    averaged = sum(p * noise.covariances[name] for name, p in noise.probabilities.items())
    ahead, behind = (
        [textbook(world, observed, averaged + step * slope)[1:] for slope in noise.slopes]
        for step in (1e-4, -1e-4)
    )
    by_entry, by_variance = (
        np.array([(x[k] - y[k]) / 2e-4 for x, y in zip(ahead, behind, strict=True)]) for k in (0, 1)
    )
    # The standard deviations themselves are as good as known.
    known = LikelihoodMaximum(sizes, 0.0, 0.0, 1e12 * np.eye(len(sizes.vector)), 0)
    correction = small_sample_correction(whole, known, noise)
    expected = 2.0 * by_entry.T @ noise.uncertainty @ by_entry
    added = correction.added_covariance[np.ix_(FITTED, FITTED)]
    np.testing.assert_allclose(added, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())
    # Satterthwaite: the logarithm of a variance with n degrees of freedom has the variance 2 / n.
    variance = np.diagonal(textbook(world, observed, averaged)[2])
    of_logarithm = np.diagonal(by_variance, axis1=1, axis2=2) / variance
    spread = np.einsum("ki,kl,li->i", of_logarithm, noise.uncertainty, of_logarithm)
    np.testing.assert_allclose(correction.degrees_of_freedom[FITTED], 2.0 / spread, rtol=1e-2)


def test_undecided_hypotheses_widen_the_covariance_by_their_disagreement(world):
    observed, views, noise = estimated(world, 7, in_base(AXES))
    equal = np.tile(np.diag(np.repeat([0.4, 0.2], 3) ** 2), (VIEWS, 1, 1))
    axes = noise.covariances["base axes"]
    undecided = noise._replace(
        probabilities={"equal": 0.25, "base axes": 0.75},
        covariances={"equal": equal, "base axes": axes},
    )
    whole, sizes = own_axes(views, noise)
    found = between_directions_covariance(whole, undecided, sizes)[np.ix_(FITTED, FITTED)]
    averaged = sum(p * noise.covariances[name] for name, p in noise.probabilities.items())
    at = textbook(world, observed, averaged)[1]
    away = [textbook(world, observed, each)[1] - at for each in (equal, axes)]
    expected = 0.25 * np.outer(away[0], away[0]) + 0.75 * np.outer(away[1], away[1])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9 * np.abs(expected).max())


def test_a_state_that_nobody_saw_changes_nothing(world):
    """Its correction is held, and the views tell nothing of it."""
    _, views, expected = estimated(world, 1, in_base(AXES))
    matrix, gradient, offset = views.matrix, views.gradient, views.offset_from_prior
    free = np.append(views.per_view_free, np.zeros((1, 6), dtype=bool), axis=0)
    unseen = views._replace(
        matrix=with_fields(
            matrix, border=with_zero(matrix.border), per_view=with_zero(matrix.per_view)
        ),
        gradient=gradient._replace(per_view=with_zero(gradient.per_view)),
        offset_from_prior=offset._replace(per_view=with_zero(offset.per_view)),
        per_view_free=free,
    )
    noise = estimate_directions(unseen, TRUTH, np.append(TURNS, TURNS[:1], axis=0))
    assert noise is not None
    assert noise.probabilities == pytest.approx(expected.probabilities)
    np.testing.assert_allclose(noise.covariance[:VIEWS], expected.covariance, rtol=1e-6)
    np.testing.assert_allclose(noise.covariance[-1], expected.covariance[0], rtol=1e-6)


def with_zero(blocks):
    """The blocks of all views, and a block of zeros."""
    return np.append(blocks, np.zeros_like(blocks[:1]), axis=0)


def test_held_corrections_have_no_directions(world):
    observed = drawn(world, 1, in_base(AXES))
    views = jax.tree.map(np.asarray, linearised(world, observed))
    free = views.per_view_free.copy()
    free[3, 2] = False
    assert estimate_directions(views._replace(per_view_free=free), TRUTH, TURNS) is None
