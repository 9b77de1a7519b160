import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import scene_of
from scipy_optimum import scipy_optimum
from starts import nudged

from smartview_jax import Noise, Rig
from smartview_jax.engine import build_rig, solve, with_lens
from smartview_jax.simulation import paper_calibration

NOISE = Noise(0.15, 1e-4, 2e-4)
"""Noise of the scene below, as stated."""


@pytest.fixture(scope="module")
def pair():
    """The problem of an arm that carries two cameras at one place, with lenses of two kinds."""
    data = scene_of(0, translation_noise=1e-4).data
    start = nudged(paper_calibration())
    starts = {"left": start, "right": with_lens(start, "opencv4")}
    return build_rig(Rig({"left": data, "right": data}), starts, noise=NOISE).problem


def test_scipy_finds_the_same_optimum(pair):
    """Two cameras share the corrections of the robot's states, and the pose of the target."""
    problem = pair
    solution, _ = solve(problem)
    found, unravel = scipy_optimum(problem, problem.zero_step())
    assert found.cost == pytest.approx(solution.costs[-1], rel=1e-9)
    by_scipy = unravel(jnp.asarray(found.x))
    np.testing.assert_allclose(by_scipy.per_view, solution.z.per_view, atol=1e-8)


def test_the_gradient_is_the_derivative_of_the_cost(pair):
    problem = pair

    def cost(z):
        return 0.5 * sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(problem.residuals(z)))

    z = jax.tree.map(lambda x: x + 1e-5, problem.zero_step())
    derivative = jax.jit(jax.grad(cost))(z)
    gradient = jax.jit(lambda z: problem.normal_equations(z).gradient)(z)
    for own, automatic in zip(gradient, derivative, strict=True):
        np.testing.assert_allclose(own, automatic, rtol=1e-7, atol=1e-4)
    np.testing.assert_allclose(
        jax.jit(lambda z: problem.normal_equations(z).cost)(z), cost(z), rtol=1e-12
    )
