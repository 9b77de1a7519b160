"""How programs are compiled: quickly where little is computed, well where much is.

XLA's time is most of what a first answer takes. Its fusion emitters for the CPU take nearly half of
it and gain next to nothing in a fit; optimising by LLVM costs as much as a thousand small fits.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

MUCH = 30_000
"""Numbers in the arguments from which a program is optimised: some five thousand observations."""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """`eqx.filter_jit`, optimised or not by how much the function is given."""
    quickly, well = _compiled(function, 0), _compiled(function, 2)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        given = sum(x.size for x in jax.tree.leaves((args, kwargs)) if hasattr(x, "size"))
        # What it costs and gains was measured on CPUs.
        little = given < MUCH and jax.default_backend() == "cpu"
        return (quickly if little else well)(*args, **kwargs)

    return call


def optimised(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """`eqx.filter_jit`, for what computes much from little: long loops, many views of few points.

    At the third of LLVM's levels, XLA's own choice, the linearisation of many points takes twice as
    long as at the second.
    """
    return _compiled(function, 2)


def _compiled(function: Callable[_P, _R], level: int) -> Callable[_P, _R]:
    options = {"xla_backend_optimization_level": level, "xla_cpu_use_fusion_emitters": False}
    alone = eqx.filter_jit(function, compiler_options=options)  # pyright: ignore[reportCallIssue]
    # Inside another program that one's options hold, and JAX takes no others.
    inside = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        traced = any(isinstance(x, Tracer) for x in jax.tree.leaves((args, kwargs)))
        return (inside if traced else alone)(*args, **kwargs)

    return call
