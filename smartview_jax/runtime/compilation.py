"""Compile functions with JAX, with little optimisation for small inputs and more for large ones.

Compilation by XLA takes most of the time to a first result. XLA's fusion emitters for the CPU need
nearly half of that time and hardly speed up a fit; optimisation by LLVM costs as much time as a
thousand small fits. Compiled programs are kept for later processes (`compilation_cache`).
"""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
from jax.core import Tracer

from .compilation_cache import keep_compiled_programs
from .double_precision import require_double_precision

try:
    from .program_store import ProgramStore
except ImportError:
    # `program_store` is optional: it uses parts of JAX that may change, and can be deleted.
    ProgramStore = None

MIN_OPTIMISED_ELEMENTS = 30_000
"""Smallest number of array elements in the arguments for which the optimised program is used.

It corresponds to about five thousand observations.
"""

_min_elements = MIN_OPTIMISED_ELEMENTS
"""The number that applies in this process."""

CPU_OPTIONS = {
    # The emitters are left out to save time (see the module's docstring).
    "xla_cpu_use_fusion_emitters": False,
    # LLVM could compile parts in threads, but splitting costs more time than the threads save.
    "xla_cpu_parallel_codegen_split_count": 1,
}
"""XLA's options for programs on CPUs."""

FAST_COMPILING_OPTIONS = {
    # These passes move what is constant out of a solver's loop, one layer at a time, and all other
    # passes run again after each layer: a third of the compilation of a fit.
    "xla_disable_hlo_passes": (
        "while-loop-invariant-code-motion,while-loop-constant-sinking,simplify-while-loops"
    ),
}
"""XLA's further options for programs on CPUs that run on little data."""

FIRST_VERSION_TO_ASK = (0, 11)
"""The first version of JAX that is asked which compiler options it has; earlier ones have all."""

_P = ParamSpec("_P")
_R = TypeVar("_R")


def is_traced(*trees: Any) -> bool:
    """Return whether any array in the arguments is traced by `jit`, `grad` or `vmap`."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def refuse_traced(function: str, *trees: Any) -> None:
    """Raise a TypeError if a function that works on the host is called within a transformation.

    Args:
        function: name of the function, for the message.
        trees: its arguments.
    """
    if is_traced(*trees):
        raise TypeError(
            f"{function} cannot be traced by jit, grad or vmap, because it decides by the values "
            "of its data. For derivatives and batches of a fit use sv.optimum: build the "
            "problem once by sv.build_problem, outside, and change its arrays by eqx.tree_at"
        )


def optimise_all_programs() -> None:
    """Use the optimised programs for small arguments too, from now on in this process.

    It pays for thousands of small fits: their programs then run in two thirds of the time.
    """
    global _min_elements
    _min_elements = 0


def one_program(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Run a function as one program when it is called outside of a transformation.

    Without this, JAX compiles dozens of small programs for each shape of the arguments. Within
    `jit`, `grad` or `vmap` the function itself is called.
    """
    program = _compiled_when_called(function)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        return (function if is_traced(args, kwargs) else program())(*args, **kwargs)

    return call


def _compiled_when_called(function: Callable[_P, _R]) -> Callable[[], Callable[_P, _R]]:
    """Return a function that returns the given one compiled, always the same.

    `filter_jit` takes a millisecond to look at a function, and a process calls few of those that
    it imports.
    """
    return functools.cache(lambda: eqx.filter_jit(function))


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function with `eqx.filter_jit`, optimised only if its arguments are large.

    Two programs are prepared. A call on a CPU with fewer than `MIN_OPTIMISED_ELEMENTS` array
    elements runs the one that compiles quickly; every other call runs the optimised one, as do all
    calls after `optimise_all_programs`.
    """
    # Nothing is compiled yet: `filter_jit` compiles at the first call with new shapes.
    fast_compiling = _compiled_at_level(function, 0)
    fully_optimised = _compiled_at_level(function, 2)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        leaves, structure = jax.tree.flatten((args, kwargs))
        element_count = sum(getattr(leaf, "size", 0) for leaf in leaves)
        # Cost and benefit of optimisation were measured on CPUs only, so other backends always
        # optimise.
        is_small = element_count < _min_elements and jax.default_backend() == "cpu"
        return (fast_compiling if is_small else fully_optimised)(args, kwargs, leaves, structure)

    return call


def compiled_optimised(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function with `eqx.filter_jit`, always optimised.

    Use it for functions that compute much from small arguments: long loops, or many views of few
    points. LLVM's level 2 is used: at level 3, XLA's own default, the linearisation of many points
    takes twice as long as at level 2.
    """
    program = _compiled_at_level(function, 2)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        return program(args, kwargs, *jax.tree.flatten((args, kwargs)))

    return call


def _compiled_at_level(
    function: Callable[..., _R], optimisation_level: int
) -> Callable[[Any, Any, list[Any], Any], _R]:
    """Compile a function with `eqx.filter_jit` at an LLVM level, without fusion emitters.

    Returns:
        The program of the arguments by position and by name, which are given a second time
        flattened: the leaves and the structure of `(args, kwargs)`.
    """
    # A user's setting of JAX for all programs applies here too.
    if jax.config.values["jax_disable_most_optimizations"]:
        optimisation_level = 0

    # At the first call, because an import must not start JAX's devices.
    @functools.cache
    def prepared() -> tuple[Any, Callable[..., _R]]:
        cpu_options = CPU_OPTIONS | (FAST_COMPILING_OPTIONS if optimisation_level == 0 else {})
        options = {"xla_backend_optimization_level": optimisation_level} | _known(cpu_options)
        store = ProgramStore and ProgramStore(function, options)
        return store, eqx.filter_jit(function, compiler_options=options)  # pyright: ignore[reportCallIssue]

    # Within the trace of another program JAX accepts no compiler options: the outer ones apply.
    nested = _compiled_when_called(function)

    def call(args: Any, kwargs: Any, leaves: list[Any], structure: Any) -> _R:
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return nested()(*args, **kwargs)
        require_double_precision()
        keep_compiled_programs()
        store, top_level = prepared()
        if store is not None:
            program, arrays = store.find(leaves, structure)
            if program is not None:
                return program(arrays)
        return top_level(*args, **kwargs)

    return call


def _known(options: dict[str, Any]) -> dict[str, Any]:
    """Return the compiler options without those that this version of XLA lacks."""
    if jax.__version_info__ < FIRST_VERSION_TO_ASK:
        return options
    return {name: value for name, value in options.items() if _is_option(name, value)}


@functools.cache
def _is_option(name: str, value: Any) -> bool:
    """Return whether XLA has a compiler option; it refuses to compile with one that it lacks."""
    try:
        jax.jit(lambda x: x).lower(0.0).compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError:
        return False
    return True
