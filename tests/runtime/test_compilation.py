"""Programs are compiled by how much they are given, and are the same functions either way."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smartview_jax
from smartview_jax.runtime import compilation
from smartview_jax.runtime.compilation import compiled, compiled_optimised, one_program

PACKAGE = Path(smartview_jax.__file__).parent

OPTIONS_OF_ALL = {"xla_backend_optimization_level": 2}
"""A compiler option that all versions of XLA have."""

AS_XLA_DOES = {"compilation.py", "store.py", "commands.py"}
"""The last predicts a million viewpoints a second, where the fusion emitters pay."""


def root_mean_square(x):
    return jnp.sqrt(jnp.mean(x**2))


@pytest.mark.parametrize("decorator", [compiled, compiled_optimised])
@pytest.mark.parametrize("count", [3, compilation.MIN_OPTIMISED_ELEMENTS])
def test_the_same_function_for_little_and_for_much(decorator, count):
    x = np.random.default_rng(0).normal(size=count)
    np.testing.assert_allclose(decorator(root_mean_square)(x), np.sqrt(np.mean(x**2)), rtol=1e-12)


@pytest.mark.parametrize("decorator", [compiled, compiled_optimised])
def test_inside_other_programs_and_under_derivatives(decorator):
    """JAX refuses options for a program inside another one."""
    function, x = decorator(root_mean_square), jnp.arange(1.0, 7.0).reshape(2, 3)
    expected = jax.vmap(root_mean_square)(x)
    np.testing.assert_allclose(jax.vmap(function)(x), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(jax.vmap(function))(x), expected, rtol=1e-14)
    np.testing.assert_allclose(
        jax.grad(function)(x), x / (x.size * root_mean_square(x)), rtol=1e-14
    )


def test_what_is_given_decides(monkeypatch):
    levels = []

    def recorded(function, level):
        return lambda args, *_: levels.append(level) or function(*args)

    monkeypatch.setattr(compilation, "_compiled_at_level", recorded)
    function = compiled(root_mean_square)
    function(jnp.zeros(compilation.MIN_OPTIMISED_ELEMENTS - 1))
    function(jnp.zeros(compilation.MIN_OPTIMISED_ELEMENTS))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    function(jnp.zeros(compilation.MIN_OPTIMISED_ELEMENTS - 1))
    assert levels == [0, 2, 2]


def test_optimised_on_request(monkeypatch):
    levels = []
    monkeypatch.setattr(
        compilation,
        "_compiled_at_level",
        lambda function, level: lambda args, *_: levels.append(level) or function(*args),
    )
    monkeypatch.setattr(compilation, "_min_elements", compilation.MIN_OPTIMISED_ELEMENTS)
    function = compiled(root_mean_square)
    function(jnp.zeros(3))
    compilation.optimise_all_programs()
    function(jnp.zeros(3))
    assert levels == [0, 2]


def test_options_that_the_compiler_lacks_are_left_out(monkeypatch):
    """XLA would refuse to compile anything with them."""
    monkeypatch.setattr(compilation, "FIRST_VERSION_TO_ASK", (0,))
    assert compilation._known({"no_such_option": 1, **OPTIONS_OF_ALL}) == OPTIONS_OF_ALL


def test_small_programs_are_compiled_without_passes_over_loops():
    """They are as right without: XLA only moves and removes what does not matter."""

    def powers(x):
        return jax.lax.fori_loop(0, 5, lambda i, y: y * jnp.cos(x) + i, x)

    x = jnp.linspace(0.0, 1.0, 7)
    np.testing.assert_allclose(compiled(powers)(x), jax.jit(powers)(x), rtol=1e-14)
    assert compilation._is_option(*next(iter(compilation.FAST_COMPILING_OPTIONS.items())))


def test_no_program_is_compiled_otherwise():
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        # Most files need not be parsed.
        if "jit" not in text or file.name in AS_XLA_DOES:
            continue
        names = {n.attr for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Attribute)}
        if names & {"jit", "filter_jit"}:
            found.append(str(file.relative_to(PACKAGE)))
    assert found == []


def test_a_function_is_looked_at_when_it_is_called(monkeypatch):
    """A process imports hundreds of functions, and calls a few."""
    looked_at = []
    monkeypatch.setattr("equinox.filter_jit", lambda function, **_: looked_at.append(function))
    for decorate in (compiled, compiled_optimised, one_program):
        decorate(np.sin)
    assert not looked_at
