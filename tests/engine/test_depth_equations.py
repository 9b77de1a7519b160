"""Depths at the points: normal equations against JAX's derivatives, and the optimum of SciPy."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from depth_scene import NOISE, depth_scene
from jax.flatten_util import ravel_pytree
from scipy_optimum import residuals_and_jacobian, scipy_optimum

from smartview_jax import Noise
from smartview_jax.calibration import flat_shape
from smartview_jax.engine import build_problem, solve
from smartview_jax.robot_errors import LinearInPosition

PIXEL, TRANSLATION, ROTATION, COMMON = 0.15, 1e-4, 2e-4, 3e-4


@pytest.fixture(scope="module")
def problem():
    """A problem with free size of the target, a field of the robot's errors, and depths."""
    scene = depth_scene(0, translation_noise=TRANSLATION)
    field = LinearInPosition.from_poses(scene.data.base_from_tool)
    return build_problem(
        scene.data.with_depths(scene.depths, dataclasses.replace(NOISE, common=COMMON)),
        scene.truth,
        noise=Noise(PIXEL, TRANSLATION, ROTATION, field=(1e-3, 1e-3)),
        field=field,
        free=("target_scale",),
    ).problem


def test_the_optimum_is_that_of_scipy(problem):
    solution, _ = solve(problem)
    found, _ = scipy_optimum(problem, problem.zero_step())
    assert solution.costs[-1] == pytest.approx(found.cost, rel=1e-9)
    flat = np.asarray(ravel_pytree(solution.z)[0])
    _, J = residuals_and_jacobian(problem, flat)
    std = np.sqrt(np.diagonal(np.linalg.inv(J.T @ J)))
    assert np.abs((flat - found.x) / std).max() < 1e-3


def test_residuals_have_the_covariance_of_single_and_common_errors(problem):
    """Their squares add up to r^T C^-1 r, with C = diag(std^2) + COMMON^2 in each view."""
    calibration, _ = problem.calibration(problem.zero_step())
    depths = problem.observations.depths
    used = depths.used & np.asarray(problem.observations.visible)
    poses = np.asarray(calibration.camera_from_world_matrices(problem.observations.command))
    points = np.asarray(problem.observations.points)
    z = np.einsum("vk,vpk->vp", poses[:, 2, :3], points) + poses[:, 2, 3, None]
    flat = np.asarray(ravel_pytree(problem.zero_step())[0])
    # Pixels come first, two numbers each.
    found = np.asarray(residuals_and_jacobian(problem, flat)[0])[2 * used.size :]
    residuals = found[: used.size].reshape(used.shape)
    for view, own in enumerate(used):
        off = (np.asarray(depths.measured) - z)[view, own]
        covariance = np.diag(np.asarray(depths.precision)[view, own] ** -2.0) + COMMON**2
        expected = off @ np.linalg.solve(covariance, off)
        assert np.sum(residuals[view] ** 2) == pytest.approx(expected, rel=1e-9)


def test_normal_equations_are_those_of_the_residuals(problem):
    flat, unravel = ravel_pytree(problem.zero_step())
    rng = np.random.default_rng(0)
    z = np.asarray(flat) + 1e-3 * rng.normal(size=flat.shape)
    r, J = map(np.asarray, residuals_and_jacobian(problem, z))
    found = eqx.filter_jit(lambda p, z: p.normal_equations(unravel(z)))(problem, z)
    whole, shared = J.T @ J, len(problem.free)
    assert float(found.cost) == pytest.approx(0.5 * float(r @ r), rel=1e-12)
    scale = np.sqrt(np.diagonal(whole))
    off = (np.asarray(ravel_pytree(found.gradient)[0]) - J.T @ r) / scale
    assert np.abs(off).max() < 1e-8 * np.linalg.norm(r)
    units = np.outer(scale, scale)[:shared, :shared]
    np.testing.assert_allclose(
        found.matrix.shared / units, whole[:shared, :shared] / units, atol=1e-9
    )
    border = np.asarray(found.matrix.border).reshape(-1, shared)
    units = np.outer(scale[shared:], scale[:shared])
    np.testing.assert_allclose(border / units, whole[shared:, :shared] / units, atol=1e-9)


def test_views_and_the_shape_of_the_target_add_up(problem):
    z = problem.zero_step()
    seen = problem.observations
    shape = flat_shape(np.asarray(seen.points), np.asarray(seen.visible))

    @eqx.filter_jit
    def compared(problem, shape):
        def cost(coefficients):
            bent = eqx.tree_at(lambda s: s.coefficients, shape, coefficients)
            observations = problem.observations.of_shape(bent)
            moved = eqx.tree_at(lambda p: p.observations, problem, observations)
            pixels, depths = moved.observation_residuals(z)
            return 0.5 * (jnp.sum(pixels**2) + jnp.sum(depths**2))

        return (
            problem.normal_equations_without_priors(z, shape),
            problem.gradients_by_view(z),
            problem.blocks_by_view(z),
            jax.grad(cost)(shape.coefficients),
        )

    whole, gradients, blocks, by_shape = compared(problem, shape)
    count = len(problem.free)
    np.testing.assert_allclose(whole.gradient.shared[count:], by_shape, rtol=1e-8)
    np.testing.assert_allclose(
        gradients.sum(axis=0), whole.gradient.shared[:count], rtol=1e-6, atol=1e-6
    )
    scale = np.sqrt(np.diagonal(whole.matrix.shared[:count, :count]))
    units = np.outer(scale, scale)
    found = np.asarray(blocks.shared.sum(axis=0)) / units
    np.testing.assert_allclose(found, whole.matrix.shared[:count, :count] / units, atol=1e-9)
    np.testing.assert_allclose(blocks.per_view, whole.matrix.per_view, rtol=1e-9, atol=1e-6)
