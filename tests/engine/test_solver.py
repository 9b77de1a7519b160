"""`StructuredLM` minimises the problem that it linearises, and refuses every other function."""

import jax.numpy as jnp
import optimistix as optx
import pytest

from smartview_jax.engine import StructuredLM
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
