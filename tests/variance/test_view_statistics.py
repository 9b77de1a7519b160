import jax
import numpy as np
import pytest
from fit_scenes import scene_of
from starts import nudged

from smartview_jax import Noise, Prior
from smartview_jax.engine import build_problem, solve
from smartview_jax.robot_errors import LinearInPosition
from smartview_jax.variance.standard_deviations import StandardDeviations
from smartview_jax.variance.view_statistics import (
    ViewStatistics,
    with_free_poses,
    with_prior_sigmas,
)


@pytest.fixture(scope="module")
def statistics():
    """With priors about values other than the start's, a view left out, and a correction held."""
    scene = scene_of(2, translation_noise=1e-4)
    built = build_problem(
        scene.data.mask_views([5]),
        nudged(scene.calibration),
        noise=Noise(1.0, 1.0, 1.0, field=(1.0, 1.0)),
        field=LinearInPosition.from_poses(scene.data.base_from_tool),
        free=("target_scale",),
        fixed=(f"pose_corrections.{scene.data.view_ids[2]}.rotation",),
        priors={
            "camera.alpha_u": Prior(std=3.0, mean=2010.0),
            "target_scale": Prior(std=0.01, mean=0.99),
        },
    )
    return ViewStatistics(built, built.pose_parameters(np.delete(np.arange(8), 5)), 100.0)


SIGMAS = StandardDeviations(0.3, 2e-4, 4e-4, np.array([1e-4, 3e-4]))


@pytest.mark.parametrize("poses_are_free", [True, False])
def test_a_fit_has_been_linearised_already(statistics, poses_are_free):
    """Without priors, its normal equations equal another pass over the pixels."""
    problem, group_index = statistics.problem, statistics.group_index
    problem = (
        with_free_poses(problem)
        if poses_are_free
        else with_prior_sigmas(problem, SIGMAS, group_index)
    )
    solution, equations = solve(problem)
    found = statistics.linearised_at_fit(problem, solution.z, equations)
    expected = statistics.linearise(solution.z)
    assert not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(found))
    size = np.sqrt(np.diagonal(expected.matrix.shared))
    scaled = [views.matrix.shared / np.outer(size, size) for views in (found, expected)]
    np.testing.assert_allclose(*scaled, atol=1e-10)
    for mine, other in (
        (found.matrix.per_view, expected.matrix.per_view),
        (found.matrix.border, expected.matrix.border),
        *zip(found.offset_from_prior, expected.offset_from_prior, strict=True),
    ):
        np.testing.assert_allclose(mine, other, atol=1e-10 * np.abs(other).max())
    np.testing.assert_allclose(
        found.residual_sum_of_squares, expected.residual_sum_of_squares, rtol=1e-9
    )
    # The gradient is nearly zero at a fit: what rounding leaves is a share of |J column| |r|.
    residual_norm = np.sqrt(2.0 * np.asarray(equations.cost))
    diagonal = expected.matrix.diagonal()
    for mine, other, squares in zip(found.gradient, expected.gradient, diagonal, strict=True):
        rounding = 1e-12 * np.sqrt(np.max(squares)) * residual_norm
        assert rounding < 1e-3 * np.abs(other).max()
        np.testing.assert_allclose(mine, other, atol=rounding)


def test_offsets_are_from_the_means_of_the_priors(statistics):
    z = statistics.problem.zero_step()
    offset = statistics.linearise(z).offset_from_prior.shared
    start = statistics.problem.parameters.start
    # The parameter of the target's scale is its logarithm.
    expected = [start.camera.alpha_u - 2010.0, np.log(start.target_scale / 0.99)]
    np.testing.assert_allclose(offset[offset != 0.0], expected, rtol=1e-12)
