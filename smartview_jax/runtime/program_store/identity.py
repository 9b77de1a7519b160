"""Describe everything that determines a compiled program, as the key under which it is kept.

A program is determined by its function, the shapes of its arguments and everything in them that is
not an array, the sources of this package, the versions of the libraries, the processor, and the
settings of JAX. If classes or functions of a user are involved, there is no key, because their
source may change.
"""

import functools
import io
import operator
import os
import pickle
import sys
import zlib
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any

import jax

_PACKAGE = __name__.partition(".")[0]

_LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "jaxlie", "numpy")
"""The libraries involved in tracing; their versions stand for their sources."""

_KNOWN_MODULES = {_PACKAGE, *_LIBRARIES, "jax_dataclasses", "builtins", "copyreg", "enum"}
"""The top-level modules whose classes and functions may occur in arguments."""


def known_name(function: Any) -> str | None:
    """Return the full name of a function or class of a known library; None for any other."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", "")
    # A nested function may depend on variables of the enclosing one.
    if not module or module.partition(".")[0] not in _KNOWN_MODULES or "<" in name:
        return None
    return f"{module}.{name}"


class _UnknownSourceError(Exception):
    """A class or function does not belong to a library whose source is known."""


class _Pickler(pickle.Pickler):
    """Pickles only objects of known libraries, and equal objects to equal bytes."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        # Otherwise a string that occurs twice gives other bytes than two equal strings.
        self.fast = True

    def reducer_override(self, obj: Any) -> Any:
        """Refuse classes and functions that the user defined."""
        if isinstance(obj, type | FunctionType) and known_name(obj) is None:
            raise _UnknownSourceError(f"{obj!r} is of {obj.__module__}")
        return NotImplemented


def pickled_if_known(tree: Any) -> bytes | None:
    """Return a tree as bytes, the same for equal trees; None if it contains a user's definition."""
    file = io.BytesIO()
    # A class that cannot be pickled, such as a local one, may raise any exception.
    with suppress(Exception):
        _Pickler(file).dump(tree)
        return file.getvalue()
    return None


def compiler() -> bytes:
    """Return everything except the text that determines how a program is compiled."""
    values = jax.config.values
    settings = [(name, values[name]) for name in _relevant_settings(len(values))]
    flags = os.environ.get("XLA_FLAGS", "")
    return repr((_versions_and_processor(), settings, flags)).encode()


@functools.cache
def _relevant_settings(_count: int) -> tuple[str, ...]:
    """Return the names of JAX's settings that may change a program; `_count` is of all settings."""
    irrelevant = ("cache", "log", "traceback")
    return tuple(
        sorted(name for name in jax.config.values if not any(word in name for word in irrelevant))
    )


@functools.cache
def _versions_and_processor() -> tuple[Any, ...]:
    """Return the versions of Python and of the libraries, and the processor."""
    return sys.version, tuple(version(name) for name in _LIBRARIES), _processor()


def _processor() -> str:
    """Return Linux's description of the processor's instructions; elsewhere the machine's name."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        described = ("model name", "flags", "Features", "CPU part")
        return "\n".join(sorted({line for line in lines if line.startswith(described)}))
    return repr(os.uname()) if hasattr(os, "uname") else sys.platform


@functools.cache
def sources() -> bytes:
    """Return path, time and size of every source of the package, as Python itself tells changes."""
    package = sys.modules[_PACKAGE].__path__[0]
    return repr(sorted(_stamps(Path(package)))).encode()


def _stamps(folder: Path) -> Iterator[tuple[str, int, int]]:
    """Yield path, time and size of every source in a folder."""
    for entry in os.scandir(folder):
        if entry.is_dir():
            yield from _stamps(Path(entry.path))
        elif entry.name.endswith(".py"):
            status = entry.stat()
            yield entry.path, status.st_mtime_ns, status.st_size


def constants() -> dict[str, int]:
    """Return a checksum of the constants and functions of every module of the package, by name.

    A user who changes one of them in a running process, such as a limit, gets separate programs.
    """
    # Packages (`__init__`) are skipped: they define nothing, and some import names lazily.
    return {
        name: _checksum_of_module(name, vars(module).copy())
        for name, module in sys.modules.copy().items()
        if name.partition(".")[0] == _PACKAGE and not hasattr(module, "__path__")
    }


_checksums: dict[str, tuple[list[Any], int]] = {}
"""The variables of every module when its checksum was computed, and the checksum."""


def _checksum_of_module(name: str, variables: dict[str, Any]) -> int:
    """Return the checksum of a module, computed again if one of its variables was replaced."""
    values = list(variables.values())
    before, checksum = _checksums.get(name, ([], 0))
    if len(before) != len(values) or not all(map(operator.is_, before, values)):
        checksum = _checksum(variables)
        _checksums[name] = values, checksum
    return checksum


def _checksum(variables: dict[str, Any]) -> int:
    """Return a checksum of the plain values, and of the names of functions, among variables."""
    texts = []
    for name, value in variables.items():
        if _is_plain(value) and not name.startswith("__"):
            texts.append(f"{name}={value!r}")
        elif isinstance(value, FunctionType):
            texts.append(f"{name}={value.__module__}.{value.__qualname__}")
    return zlib.crc32("\n".join(sorted(texts)).encode())


def _is_plain(value: Any) -> bool:
    """Return whether a value prints the same in every process."""
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, bool | int | float | str)
