import jax
import jax.numpy as jnp
import numpy as np
import pytest
from depth_scene import depth_scene
from fit_scenes import VIEWS, scene_of
from jax.flatten_util import ravel_pytree
from programs import programs_added
from scipy_optimum import residuals_and_jacobian, scipy_optimum
from starts import nudged

from smartview_jax import Noise, Rig
from smartview_jax.engine import StructuredLM, build_rig, solve, with_lens
from smartview_jax.simulation import paper_calibration
from smartview_jax.staged import with_region

NOISE = Noise(0.15, 1e-4, 2e-4)
"""Noise of the scene below, as stated."""


def built_rig(states):
    """An arm that carries two cameras at one place, with lenses of two kinds.

    The left one measures depths too.
    """
    scene = depth_scene(0, translation_noise=1e-4)
    start = nudged(paper_calibration())
    starts = {"left": start, "right": with_lens(start, "opencv4")}
    cameras = {"left": scene.data.with_depths(scene.depths), "right": scene.data}
    rig = Rig({name: data.select(range(states)) for name, data in cameras.items()})
    return build_rig(rig, starts, noise=NOISE)


@pytest.fixture(scope="module")
def built():
    """With all states of the scene."""
    return built_rig(VIEWS)


@pytest.fixture(scope="module")
def pair(built):
    """Its problem."""
    return built.problem


def test_sizes_and_values_at_the_start_need_no_programs(built):
    """Each would be compiled for the shapes of this rig: a second at the first fit of a process."""
    with programs_added() as added:
        start, fewer = built.problem.host_start_values(), built.without_view("right", 2)
        fewer.fitted_aspects  # noqa: B018 (the property is what is tried)
        numbers = built.problem.number_count - fewer.number_count
    assert not added
    np.testing.assert_allclose(start, built.problem.start_values(), rtol=1e-12)
    assert numbers == 2 * np.asarray(scene_of(0, translation_noise=1e-4).data.visible)[2].sum()


def test_depths_count_as_measured_numbers(pair):
    left, right = depth_scene(0, translation_noise=1e-4), scene_of(0, translation_noise=1e-4)
    visible = np.asarray(right.data.visible)
    depths = np.isfinite(left.depths) & visible
    assert pair.number_count == 4 * visible.sum() + depths.sum()


def test_scipy_finds_the_same_optimum(pair):
    """Two cameras share the corrections of the robot's states, and the pose of the target."""
    problem = pair
    solution, _ = solve(problem)
    found, unravel = scipy_optimum(problem, problem.zero_step())
    assert found.cost == pytest.approx(solution.costs[-1], rel=1e-9)
    by_scipy = unravel(jnp.asarray(found.x))
    np.testing.assert_allclose(by_scipy.per_view, solution.z.per_view, atol=1e-8)


def test_rigs_with_another_number_of_states_share_a_program(pair):
    """As after a state is left out; the states that are added change no result."""
    solve(pair)
    fewer = built_rig(VIEWS - 2).problem
    with programs_added() as added:
        solution, equations = solve(fewer)
    assert not added
    assert solution.z.per_view.shape == (VIEWS - 2, 6)
    assert equations.matrix.per_view.shape == (VIEWS - 2, 6, 6)
    unpadded = fewer.normal_equations(jax.tree.map(jnp.asarray, solution.z))
    np.testing.assert_allclose(equations.cost, unpadded.cost, rtol=1e-9)
    np.testing.assert_allclose(equations.matrix.border, unpadded.matrix.border, rtol=1e-6, atol=1.0)


def test_the_gradient_is_the_derivative_of_the_cost(pair):
    """The cost is half the sum of squared residuals, so both have one derivative."""
    z = jax.tree.map(lambda x: x + 1e-5, pair.zero_step())
    residuals, jacobian = map(np.asarray, residuals_and_jacobian(pair, ravel_pytree(z)[0]))
    # With an infinite tolerance the solver ends where it begins.
    _, found = solve(pair, StructuredLM(atol=np.inf), start=z)
    gradient = ravel_pytree(found.gradient)[0]
    np.testing.assert_allclose(gradient, jacobian.T @ residuals, rtol=1e-7, atol=1e-4)
    np.testing.assert_allclose(found.cost, 0.5 * residuals @ residuals, rtol=1e-12)


def test_each_view_has_the_axes_of_its_state(pair):
    rng = np.random.default_rng(0)
    states = len(pair.per_view_free)
    roots, own = rng.normal(size=(states, 6, 6)), rng.normal(size=(states, 6))
    along = pair.with_correction_roots(roots)
    twists = [root @ each for root, each in zip(roots, own, strict=True)]
    np.testing.assert_allclose(along.host_corrections(own), twists, rtol=1e-12)
    for group in along.groups:
        seen = np.asarray(group.state_index) < states
        of_views = np.asarray(group.problems.correction_roots)[seen]
        np.testing.assert_array_equal(of_views, roots[np.asarray(group.state_index)[seen]])


def test_a_start_from_a_fit_shares_the_program_of_any_other():
    """The viewpoints that an earlier fit has seen are no part of the problem."""
    data, start = scene_of(0, translation_noise=1e-4).data, paper_calibration()
    fitted = with_region(start, data)
    assert fitted.region is not None
    structures = {
        jax.tree.structure(build_rig(Rig({"only": data}), {"only": begin}, noise=NOISE).problem)
        for begin in (start, fitted)
    }
    assert len(structures) == 1
