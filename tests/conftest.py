import functools
import gc
import os
from importlib.metadata import version
from pathlib import Path

# Most of the tests' time is XLA's. It compiles for speed what is run once on little data, unless
# it is told not to, and splits programs for more cores than two workers have.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ["XLA_FLAGS"] = " ".join(
    (
        os.environ.get("XLA_FLAGS", ""),
        # JAX 0.11 ends the process for a flag that it lacks.
        "--xla_cpu_use_fusion_emitters=false" * (version("jax") < "0.11"),
        "--xla_cpu_parallel_codegen_split_count=1",
        "--xla_disable_hlo_passes=while-loop-invariant-code-motion,while-loop-constant-sinking,"
        "simplify-while-loops",
    )
).strip()
# Programs that take long to compile are kept for the other worker, other files and the next run:
# in pytest's own folder, since the tests write nothing outside of theirs.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent.parent / ".pytest_cache" / "programs")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.05")
# Nobody reads in a profile which line of Python an instruction comes from; to note ten lines for
# each takes a tenth of the time to a program.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import equinox as eqx
import jax
import jaxlie
import numpy as np
import pytest
import scipy.linalg  # noqa: F401 (its BLAS must be there to be limited)
from public_signatures import check_public_signatures
from threadpoolctl import threadpool_limits

# Two workers on two cores: threads of one worker's BLAS would wait for the other's.
threadpool_limits(limits=1, user_api="blas")

check_public_signatures()

# What is imported and collected stays: the garbage collector would look through it again and again.
# `pytest_collection_finish` enables it.
gc.disable()

# Only now: what is imported before is not checked.
from smartview_jax.runtime.program_store import forget_programs  # noqa: E402

# The strictest JAX: silent promotion of types or ranks is an error here.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def _for_tests(group):
    """jaxlie promotes ranks and types on purpose; the strictness is for our code.

    Each call outside of a trace is compiled as one program: operation by operation it would be
    dozens for each shape, and tests call jaxlie with many shapes.
    """
    for name, method in list(vars(group).items()):
        if name.startswith("__") and name != "__matmul__":
            continue
        if isinstance(method, staticmethod | classmethod):
            setattr(group, name, type(method)(_tolerant(method.__func__)))
        elif callable(method):
            setattr(group, name, _tolerant(method))


def _tolerant(function):
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args, **kwargs):
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, kwargs))):
                return function(*args, **kwargs)
            return program(*jax.tree.map(_as_data, args), **jax.tree.map(_as_data, kwargs))

    return call


def _as_data(leaf):
    """A number is data; as it is, a program would be compiled for each value."""
    return np.float64(leaf) if type(leaf) is float else leaf


for _group in (jaxlie.SE3, jaxlie.SO3):
    _for_tests(_group)


def pytest_collection_finish():
    """What is imported by now stays: the garbage collector need not look through it again.

    Traces are made of so many small objects that it otherwise takes up to a tenth of the time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


MAX_MEMORY_MAPS = 4_500
"""Number of this process's memory maps at which its programs are let go: some 0.5 MB for each."""


@pytest.fixture(autouse=True, scope="module")
def _programs_are_let_go():
    """Programs are shared by files until they are too many: 20,000 maps hold 7 GB."""
    yield
    if _memory_map_count() > MAX_MEMORY_MAPS:
        jax.clear_caches()
        eqx.clear_caches()
        forget_programs()


def _memory_map_count():
    """Infinite where the system does not say."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return float("inf")
