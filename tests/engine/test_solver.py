"""`StructuredLM` minimises the problem that it linearises, and refuses every other function."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from programs import programs_added

from smartview_jax import Noise
from smartview_jax.engine import Step, StructuredLM, solve
from smartview_jax.engine.problem_builder import build_problem
from smartview_jax.simulation import random_scene


def test_another_function_is_refused():
    scene = random_scene(0)
    problem = build_problem(scene.data, scene.calibration).problem
    for function, start, args in (
        (lambda y, _: y - 1.0, jnp.zeros(3), None),
        (lambda y, _: y.shared, problem.zero_step(), problem),
    ):
        with pytest.raises(ValueError, match="for other functions use"):
            optx.least_squares(function, StructuredLM(), start, args=args)


def test_a_problem_along_other_axes_is_the_same_problem():
    """Roots that stretch the axes are priors that differ by axis; a rotation changes nothing."""
    scene = random_scene(1, 8, translation_noise=1e-4, rotation_noise=2e-4)
    noise = Noise(0.15, 1e-4, 2e-4)
    problem = build_problem(scene.data, scene.calibration, noise=noise).problem
    stretches = np.array([0.5, 1.0, 3.0, 2.0, 0.7, 1.0])
    weight = problem.prior_weight
    by_axis = dataclasses.replace(
        problem, prior_weight=Step(weight.shared, np.asarray(weight.per_view) / stretches)
    )
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    both = np.kron(np.eye(2), turn)
    roots = np.tile(np.diag(stretches) @ both, (8, 1, 1))
    expected, _ = solve(by_axis)
    with programs_added() as added:
        found, _ = solve(problem.with_correction_roots(roots))
    assert added == [], "a fit along other axes is run by the program of the plain one"
    assert found.costs[-1] == pytest.approx(expected.costs[-1], rel=1e-9)
    np.testing.assert_allclose(found.z.shared, expected.z.shared, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        found.chain.pose_corrections, expected.chain.pose_corrections, rtol=1e-5, atol=1e-10
    )
    plain, _ = solve(problem)
    assert np.abs(found.z.shared - plain.z.shared).max() > 1e-6
