"""Compile functions with JAX, with little optimisation for small inputs and more for large ones.

Compilation by XLA takes most of the time to a first result. XLA's fusion emitters for the CPU need
nearly half of that time and hardly speed up a fit; optimisation by LLVM costs as much time as a
thousand small fits.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

MUCH = 30_000
"""Smallest number of array elements in the arguments for which a program is compiled optimised.

It corresponds to some five thousand observations.
"""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function with `eqx.filter_jit`, optimised only if its arguments are large.

    Two programs are prepared. A call with fewer than `MUCH` array elements on a CPU runs the one
    that compiles quickly; every other call runs the optimised one.
    """
    quickly, well = _compiled(function, 0), _compiled(function, 2)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = sum(x.size for x in jax.tree.leaves((args, kwargs)) if hasattr(x, "size"))
        # The cost and gain of optimisation were measured on CPUs only, so other backends always get
        # it.
        little = given < MUCH and jax.default_backend() == "cpu"
        return (quickly if little else well)(*args, **kwargs)

    return call


def optimised(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function with `eqx.filter_jit`, always optimised.

    Use it for functions that compute much from small arguments: long loops, or many views of few
    points. LLVM's level 2 is used: at level 3, XLA's own default, the linearisation of many points
    takes twice as long as at level 2.
    """
    return _compiled(function, 2)


def _compiled(function: Callable[_P, _R], level: int) -> Callable[_P, _R]:
    """Compile a function with `eqx.filter_jit` at an LLVM level, without fusion emitters."""
    options = {"xla_backend_optimization_level": level, "xla_cpu_use_fusion_emitters": False}
    alone = eqx.filter_jit(function, compiler_options=options)  # pyright: ignore[reportCallIssue]
    # Within the trace of another program JAX accepts no compiler options: the outer ones apply.
    inside = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        traced = any(isinstance(x, Tracer) for x in jax.tree.leaves((args, kwargs)))
        return (inside if traced else alone)(*args, **kwargs)

    return call
