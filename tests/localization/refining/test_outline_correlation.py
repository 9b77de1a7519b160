"""Outlines that err alike: correlations against drawn lights, covariances against drawn errors."""

import numpy as np
import pytest

from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.localization.refining.heavy_tails import (
    light_correlations,
    solve_heavy_tailed,
    variance_of_shared,
)
from smartview_jax.localization.refining.pose_equations import CommonErrors, PoseEquations

OUTLINES = 60
SCENES = 60
NO_ERRORS = CommonErrors(np.zeros((0, 0)), np.zeros((0, 0)))


def outlines_of(rng, views=2):
    """Equations of two views of a round outline, without residuals."""
    angles = 2.0 * np.pi * np.arange(OUTLINES) / OUTLINES
    view = np.arange(OUTLINES) % views
    by_pose = rng.standard_normal((2 * OUTLINES, 6)) * [30.0, 30.0, 30.0, 60.0, 60.0, 60.0]
    along = [np.cos(angles), np.sin(angles), np.zeros(OUTLINES)]
    by_pose[::2, :3] = 3000.0 * np.stack(along, axis=1)
    by_light = np.zeros((2 * OUTLINES, views))
    by_light[::2] = 0.05 * (view[:, None] == np.arange(views))
    return PoseEquations(
        np.zeros(2 * OUTLINES),
        by_pose,
        0.02**2 * np.eye(2 * OUTLINES),
        np.zeros((2 * OUTLINES, 0)),
        np.zeros((2 * OUTLINES, 0)),
        by_light,
    )


def test_one_light_displaces_outlines_as_much_alike_as_drawn_lights_do():
    rng = np.random.default_rng(0)
    equations = outlines_of(rng, 1)
    assert equations.by_light is not None
    light = rng.standard_normal((200_000, 3))
    normals = equations.by_pose[:12:2, :3] * np.array([1.0, -1.0] * 3)[:, None]
    given = equations._replace(
        by_pose=np.repeat(normals, 2, axis=0) @ np.eye(3, 6), by_light=equations.by_light[:12]
    )
    # Seen along z, across all normals.
    shifts = light[:, 2:] * (light @ normals.T > 0.0)
    expected = np.corrcoef(shifts.T)
    np.testing.assert_allclose(light_correlations(given), expected, atol=0.02)


def test_edges_of_two_views_and_of_no_outline_err_by_themselves():
    equations = outlines_of(np.random.default_rng(1))
    assert equations.by_light is not None
    by_light = equations.by_light.copy()
    by_light[:40] = 0.0
    correlations = light_correlations(equations._replace(by_light=by_light))
    assert not correlations[:20].any()
    view = np.arange(OUTLINES) % 2
    assert not correlations[view[:, None] != view].any()
    assert (np.diagonal(correlations, 2)[20:] > 0.9).all()


def test_the_covariance_of_a_pose_has_what_neighbouring_outlines_have_in_common():
    rng = np.random.default_rng(2)
    errors, covariances, without = [], [], []
    for _ in range(SCENES):
        equations = outlines_of(rng)
        # An error of 0.02 px of each outline, and 0.05 px of all that look the same way.
        # The symmetric root is unique: the draws are the same on every machine.
        sizes, axes = np.linalg.eigh(light_correlations(equations))
        root = (axes * np.sqrt(np.maximum(sizes, 0.0))) @ axes.T
        alike = 0.05 * root @ rng.standard_normal(OUTLINES)
        residuals = 0.02 * rng.standard_normal(2 * OUTLINES)
        residuals[::2] += alike
        drawn = equations._replace(residuals=residuals)
        step = solve_heavy_tailed(drawn, NO_ERRORS).step
        errors.append(step.tangent)
        covariances.append(step.covariance)
        without.append(solve_heavy_tailed(drawn._replace(by_light=None), NO_ERRORS).step.covariance)
    squared = mean_nees(nees(np.array(errors), np.array(covariances)), 6).value
    independent = mean_nees(nees(np.array(errors), np.array(without)), 6).value
    # The mean of 60 squares errs by 0.45, and the size is an estimate.
    assert independent > 2.0 * squared
    assert 4.7 < squared < 8.0


def test_a_lone_outline_shares_nothing():
    assert variance_of_shared(np.ones(2), np.eye(2), np.ones(2), np.eye(2)) == 0.0


def test_unknowns_with_a_prior_are_not_taken_for_what_neighbours_share():
    """The pose is free; an error with a prior moves each eight edges that follow one another."""
    rng, count = np.random.default_rng(3), 400
    common = np.kron(np.eye(count // 8), np.ones((8, 1)))
    derivatives = np.hstack([rng.standard_normal((count, 6)), common])
    variances = np.full(count, 4.0)
    prior = np.diag(np.repeat([0.0, 1.0], [6, common.shape[1]]))
    information = derivatives.T @ (derivatives / variances[:, None]) + prior
    solved = np.linalg.solve(information, derivatives.T / variances)
    remaining = np.eye(count) - derivatives @ solved
    place = np.arange(count)
    shared = np.exp(-np.abs(place[:, None] - place) / 4.0)
    covariance = np.diag(variances) + common @ common.T + 4.0 * shared
    errors = rng.standard_normal((150, count)) @ np.linalg.cholesky(covariance).T
    sizes = [variance_of_shared(remaining @ e, remaining, variances, shared) for e in errors]
    assert np.mean(sizes) == pytest.approx(4.0, rel=0.1)
