"""The compiled programs of a function, in memory and on disk."""

import functools
import hashlib
import re
import threading
import time
import weakref
import zlib
from collections.abc import Callable
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax._src.config import persistent_cache_min_compile_time_secs as jaxs_shortest_time
from jax.experimental.serialize_executable import serialize

from ...files import write_atomically
from ..compilation_cache import PROGRAM_SUFFIX, TRACE_SUFFIX, is_safe_folder, only_user_can_write
from .identity import compiler, constants, known_name, pickled_if_known, sources
from .safe_pickle import pickled_trace, unpickled_program, unpickled_trace

READ_EVENT = "/smartview_jax/program_read"
"""The event that `jax.monitoring` reports, with its duration, when a program is read."""

LAPACK_NAMES = re.compile(rb"lapack_[sdcz]"), re.compile(rb"blas_[sdcz]")
"""The names by which a program calls functions of LAPACK or BLAS, to the letter of the type.

They are two patterns because one that begins with letters is found eight times as fast: programs
have a megabyte each.
"""

_PLAIN_SETTINGS = {
    "jax_enable_x64": True,
    "jax_disable_jit": False,
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_default_device": None,
    "jax_default_matmul_precision": None,
}
"""Settings that a user's context may change within a process, and the values they must have."""

_PROMOTION_SETTINGS = ("jax_numpy_rank_promotion", "jax_numpy_dtype_promotion")
"""Settings of a context that raise errors or change types while a function is traced.

They are part of a trace's key.
"""


_PLAIN_VALUES = tuple(_PLAIN_SETTINGS.values())

# A setting is an attribute of JAX's configuration, which a context may change for one thread.
_settings = functools.partial(attrgetter(*_PLAIN_SETTINGS), jax.config)
_promotion = functools.partial(attrgetter(*_PROMOTION_SETTINGS), jax.config)


class ArrayKind(NamedTuple):
    """The shape and type of an array; a program is compiled for all arrays of one kind.

    Attributes:
        shape: the shape.
        dtype: the name of the type.
        weak: whether the type gives way to others, as a Python number's does. Double precision
            gives way to nothing that is computed with here, and never counts as weak.
        sharding: the devices that hold it; None for the first one, and for an array of NumPy.
    """

    shape: tuple[int, ...]
    dtype: str
    weak: bool = False
    sharding: Any = None


class Program(NamedTuple):
    """A compiled program, and the structure of its result.

    Attributes:
        run: from the arguments' arrays to the result's arrays.
        structure: the structure of the result.
        leaves: leaves of the result, with an `ArrayKind` in the place of each array.
    """

    run: jax.stages.Compiled
    structure: Any
    leaves: list[Any]

    def __call__(self, arrays: list[Any]) -> Any:
        """Run the program, wait for it, and return the result."""
        outputs = self.run(*arrays)
        if outputs:
            outputs[0].block_until_ready()
        arrays_of_result = iter(outputs)
        return self.structure.unflatten(
            [next(arrays_of_result) if type(x) is ArrayKind else x for x in self.leaves]
        )


_stores: "weakref.WeakSet[ProgramStore]" = weakref.WeakSet()
"""All stores of this process."""


def forget_programs() -> None:
    """Drop all programs that are in memory; JAX itself holds no reference to them."""
    for store in list(_stores):
        store._forget()


class ProgramStore:
    """The programs of one function, in memory and on disk."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function = function
        self._options = options
        self._programs: dict[Any, Program | None] = {}
        self._lock = threading.RLock()
        _stores.add(self)

    def find(self, leaves: list[Any], structure: Any) -> tuple[Program | None, list[Any]]:
        """Return the program for arguments, read or compiled if necessary, and their arrays.

        The program is None if its key is unknown (see `identity`).

        Args:
            leaves, structure: the arguments by position and by name, `(args, kwargs)`, flattened.
        """
        if _settings() != _PLAIN_VALUES:
            return None, []
        kinds = [_kind_of(leaf) for leaf in leaves]
        types = tuple(map(type, kinds))
        arrays = [leaf for leaf, known in zip(leaves, types, strict=True) if known is ArrayKind]
        promotion = _promotion()
        # The types are in the key because 1 == True and 0 == False.
        key = structure, tuple(kinds), types, promotion
        programs = self._programs
        if key not in programs:
            # The lock keeps two threads from compiling the same program.
            with self._lock:
                if key not in programs:
                    arguments = structure.unflatten(kinds)
                    programs[key] = self._new_program(arguments, arrays, promotion)
        return programs[key], arrays

    def _forget(self) -> None:
        """Drop the programs in memory; a caller that is running one keeps it."""
        self._programs = {}

    def _new_program(
        self, arguments: Any, arrays: list[Any], promotion: tuple[Any, ...]
    ) -> Program | None:
        """Return the program for arguments whose arrays are replaced by their kinds."""
        folder, name = _folder(), known_name(self._function)
        if folder is None or name is None or not _are_on_first_cpu(arguments):
            return None
        description = pickled_if_known((name, self._options, arguments, promotion))
        if description is None:
            return None
        key = hashlib.sha256(compiler() + sources() + description).hexdigest()
        path = folder / f"{self._function.__name__}-{key}{TRACE_SUFFIX}"
        return _read(path, len(arrays)) or self._newly_traced(path, arguments, arrays)

    def _newly_traced(self, path: Path, arguments: Any, arrays: list[Any]) -> Program:
        """Trace the function, read or compile its program, and keep it if that took long enough."""
        start_time = time.perf_counter()
        lowered, (structure, leaves) = _lowered(self._function, arguments, arrays)
        # The text does not mention arguments that have no effect.
        described = repr((self._options, lowered.in_avals)) + lowered.as_text()
        text_digest = hashlib.sha256(compiler() + described.encode()).hexdigest()
        program_path = path.with_name(f"{self._function.__name__}-{text_digest}{PROGRAM_SUFFIX}")
        content = _content(program_path)
        run = _executable(content, len(arrays), sum(map(_is_kind, leaves)))
        # JAX's setting of the time that is worth a file; infinite if no file can be written.
        shortest = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
        if run is None:
            # JAX would write the program too; an infinite time prevents that.
            with jaxs_shortest_time(float("inf")):
                run = lowered.compile(compiler_options=self._options)
            is_worth_a_file = time.perf_counter() - start_time >= shortest
            content = _write_program(program_path, run) if is_worth_a_file else None
        if content is not None and time.perf_counter() - start_time >= shortest:
            _write_trace(path, structure.unflatten(leaves), program_path.name, content)
        return Program(run, structure, leaves)


def _is_kind(x: Any) -> bool:
    """Return whether an object stands for an array."""
    return type(x) is ArrayKind


def _kind_of(leaf: Any) -> Any:
    """Return the kind of an array; anything else unchanged."""
    # NumPy's arrays first: to ask whether something is one of JAX takes ten times as long.
    if isinstance(leaf, _HOST_ARRAYS):
        return _kind_on_host(leaf.shape, leaf.dtype)
    if isinstance(leaf, jax.Array):
        kind = _kind_on_host(leaf.shape, leaf.dtype)
        weak = leaf.weak_type and leaf.dtype != np.float64
        sharding = None if leaf.sharding == _first_device() else leaf.sharding
        return kind._replace(weak=weak, sharding=sharding) if weak or sharding else kind
    return leaf


_HOST_ARRAYS = (np.ndarray, np.generic)


@functools.lru_cache(maxsize=10_000)
def _kind_on_host(shape: tuple[int, ...], dtype: np.dtype) -> ArrayKind:
    """Return the kind of NumPy's arrays; a calibration asks a thousand times for a few of them."""
    return ArrayKind(shape, dtype.name)


@functools.cache
def _first_device() -> jax.sharding.Sharding:
    """Return the sharding of arrays on the default device."""
    return jax.sharding.SingleDeviceSharding(jax.local_devices()[0])


def _are_on_first_cpu(arguments: Any) -> bool:
    """Return whether all arrays are on the first CPU, where stored programs run."""
    if jax.default_backend() != "cpu" or jax.process_count() > 1:
        return False
    leaves = jax.tree.leaves(arguments, is_leaf=_is_kind)
    return all(x.sharding is None for x in leaves if _is_kind(x))


def _folder() -> Path | None:
    """Return the folder of JAX's cache; None if the cache is off or the folder is not safe."""
    settings = jax.config.values
    folder = settings["jax_compilation_cache_dir"]
    if not settings["jax_enable_compilation_cache"] or not folder or "://" in folder:
        return None
    return Path(folder) if is_safe_folder(folder) else None


def _lowered(
    function: Callable[..., Any], arguments: Any, arrays: list[Any]
) -> tuple[jax.stages.Lowered, tuple[Any, list[Any]]]:
    """Lower a function for arguments whose arrays are replaced by their kinds.

    Returns:
        The lowered function from arrays to arrays; and the structure and the leaves of its result,
        with arrays replaced by their kinds.
    """
    leaves, structure = jax.tree.flatten(arguments, is_leaf=_is_kind)
    result: list[Any] = []

    def on_arrays(*traced: Any) -> list[Any]:
        """Call the function on arrays, and record the structure of its result."""
        given = iter(traced)
        args, kwargs = structure.unflatten([next(given) if _is_kind(x) else x for x in leaves])
        outputs, result_structure = jax.tree.flatten(function(*args, **kwargs))
        kinds = [_kind_of_result(x) for x in outputs]
        result[:] = result_structure, kinds
        return [x for x, kind in zip(outputs, kinds, strict=True) if _is_kind(kind)]

    # JAX uses the function's name for the program in profiles and in its cache.
    on_arrays.__name__ = f"{function.__name__}_kept"
    kinds = [leaf for leaf in leaves if _is_kind(leaf)]
    lowered = jax.jit(on_arrays).lower(*map(_without_weakness, arrays, kinds))
    return lowered, (result[0], result[1])


def _without_weakness(array: Any, kind: ArrayKind) -> Any:
    """Return an array, or its shape and type where its type is weak but does not count as weak."""
    if kind.weak or not getattr(array, "weak_type", False):
        return array
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


def _kind_of_result(leaf: Any) -> Any:
    """Return the kind of an array, which may be traced; anything else unchanged."""
    is_array = isinstance(leaf, jax.Array | np.ndarray | np.generic)
    return ArrayKind(leaf.shape, leaf.dtype.name) if is_array else leaf


def _write_program(path: Path, run: jax.stages.Compiled) -> bytes | None:
    """Write a program, and return the bytes; None if it cannot be written."""
    # A program that calls Python cannot be written and may raise any exception; and a full disk
    # must not end a fit.
    with suppress(Exception):
        content = zlib.compress(serialize(run)[0], 1)
        write_atomically(path, content)
        return content
    return None


def _write_trace(path: Path, result: Any, program_name: str, program: bytes) -> None:
    """Write the structure of a result, and the name and digest of the program's file."""
    digest = hashlib.sha256(program).hexdigest()
    content = pickled_trace((constants(), result, program_name, digest))
    if content is not None:
        with suppress(OSError):
            write_atomically(path, content)


def _read(path: Path, array_count: int) -> Program | None:
    """Return the program of a trace; None if there is none that this process can run."""
    content = _content(path)
    if content is None:
        return None
    # A file that is damaged or from another version of a library is written again.
    with suppress(Exception):
        stored_constants, result, name, digest = unpickled_trace(content)
        if any(stored_constants.get(module, now) != now for module, now in constants().items()):
            return None
        program = _content(path.with_name(Path(name).name))
        if program is None or hashlib.sha256(program).hexdigest() != digest:
            return None
        leaves, structure = jax.tree.flatten(result, is_leaf=_is_kind)
        run = _executable(program, array_count, sum(map(_is_kind, leaves)))
        return None if run is None else Program(run, structure, leaves)
    return None


def _content(path: Path) -> bytes | None:
    """Return the content of a file; None if it is missing or others could have written it."""
    with suppress(OSError):
        return path.read_bytes() if only_user_can_write(path) else None
    return None


def _executable(
    content: bytes | None, array_count: int, output_count: int
) -> jax.stages.Compiled | None:
    """Return the program in a file's content; None if it cannot be read."""
    if content is None:
        return None
    start_time = time.perf_counter()
    with suppress(Exception):
        program = zlib.decompress(content)
        if any(name.search(program) for name in LAPACK_NAMES):
            _prepare_lapack()
        run = unpickled_program(program, array_count, output_count)
        jax.monitoring.record_event_duration_secs(READ_EVENT, time.perf_counter() - start_time)
        return run
    return None


@functools.cache
def _prepare_lapack() -> None:
    """Make JAX load the functions of LAPACK, as it does when it lowers the first call of one.

    A program that is only read would call functions that were never loaded, and crash.
    """
    jax.jit(jax.lax.linalg.cholesky).lower(np.eye(1))
