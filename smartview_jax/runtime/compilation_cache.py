"""Keep compiled programs on disk, so that later processes read them instead of compiling again.

JAX's persistent compilation cache is switched on when this library first compiles a program, for
the command, a script and a notebook alike. Only settings that the user left alone are changed:

- the folder, which is `smartview_jax` in $XDG_CACHE_HOME or else in ~/.cache, unless
  JAX_COMPILATION_CACHE_DIR or JAX's own configuration names another;
- the shortest compile time of a program that is kept, which becomes zero, unless
  JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS or JAX's own configuration says otherwise: a fit has
  many programs that compile in less than JAX's default of one second.

What `program_store` keeps, so that programs need not even be traced again, is in the same folder
and under the same settings.

Whoever can write a compiled program there runs it as the user. The default folder is used only if
it belongs to the user and nobody else can write it, or exchange a folder above it; in a folder that
the user names, `program_store` keeps nothing otherwise. A warning says so once.

JAX_ENABLE_COMPILATION_CACHE=0, or `jax.config.update("jax_enable_compilation_cache", False)` before
the first fit, turns it off. Programs of other libraries in the same process are kept, too.
"""

import functools
import os
import stat
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

import jax

MAX_BYTES = 1_000_000_000
"""Largest total size of the programs in the default folder, bytes; a full calibration needs 20 MB.

JAX can limit the size by itself, but only where the package filelock is installed.
"""

CACHE_SUFFIX, PROGRAM_SUFFIX, TRACE_SUFFIX = "-cache", "-program", "-trace"
"""The ends of the names of files: of JAX's cache, and of the two kinds of `program_store`."""

_JAX_MIN_COMPILE_TIME = 1.0
"""JAX's own default of the shortest compile time of a program that is kept, s."""


@functools.cache
def keep_compiled_programs() -> None:
    """Switch on JAX's persistent compilation cache, once per process, unless the user forbids it.

    Where no file can be written, programs that are already there are read, and none is added.
    """
    settings = jax.config.values
    if not settings["jax_enable_compilation_cache"]:
        return
    chosen = settings["jax_compilation_cache_dir"]
    folder = _default_folder() if chosen is None else chosen
    # Text that is empty is how a user names no folder.
    if not folder:
        return
    writable = _is_writable(folder)
    # Storage on a network has owners of its own kind.
    if "://" not in folder and Path(folder).is_dir() and not is_safe_folder(folder):
        warnings.warn(_why_unsafe(folder), stacklevel=2)
        if chosen is None:
            return
    if chosen is None:
        if not Path(folder).is_dir():
            return
        jax.config.update("jax_compilation_cache_dir", folder)
        if writable:
            _remove_least_recently_used(Path(folder), MAX_BYTES)
    is_default = settings["jax_persistent_cache_min_compile_time_secs"] == _JAX_MIN_COMPILE_TIME
    if is_default and "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # JAX would warn once for every program that it fails to write.
        shortest = 0.0 if writable else float("inf")
        jax.config.update("jax_persistent_cache_min_compile_time_secs", shortest)


def _default_folder() -> str | None:
    """Return the folder for compiled programs; None for a user without a home."""
    try:
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return str(Path(caches) / "smartview_jax")


def _is_writable(folder: str) -> bool:
    """Return whether a file can be written to a folder, which is created if it is missing."""
    # Storage on a network is written by JAX with a library of its own.
    if "://" in folder:
        return True
    try:
        # Compiled programs are run unchecked, so that nobody else may be able to put some there.
        Path(folder).mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def is_safe_folder(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder exists where nobody but the user, or root, can put a program."""
    try:
        path = Path(folder).resolve(strict=True)
        return (
            path.is_dir()
            and only_user_can_write(path)
            and not any(_can_be_exchanged_in(parent.stat()) for parent in path.parents)
        )
    except OSError:
        return False


def only_user_can_write(path: Path) -> bool:
    """Return whether a file or folder belongs to the user or root, and nobody else may write it."""
    if not hasattr(os, "geteuid"):
        return True  # Windows keeps what is in a user's profile from others.
    status = path.stat()
    by_others = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return status.st_uid in (0, os.geteuid()) and not by_others


def _can_be_exchanged_in(parent: os.stat_result) -> bool:
    """Return whether another user could exchange an entry of a folder."""
    if not hasattr(os, "geteuid"):
        return False
    is_others = parent.st_uid not in (0, os.geteuid())
    # In a sticky folder, such as /tmp, only the owner of an entry may rename it.
    is_open = parent.st_mode & stat.S_IWOTH and not parent.st_mode & stat.S_ISVTX
    return bool(is_others or is_open)


def _why_unsafe(folder: str) -> str:
    """Return what is wrong with a folder, and what ends it."""
    return (
        f"compiled programs are not kept in {folder}: another user could write there what would "
        "then run as you. Expected a folder that belongs to you, which nobody else can write, "
        "within folders that nobody else can rename: chmod go-w it, or name another one by "
        "JAX_COMPILATION_CACHE_DIR"
    )


def _remove_least_recently_used(folder: Path, max_bytes: int) -> None:
    """Remove the programs that were last read longest ago, until the rest is small enough."""
    sizes_by_time: list[tuple[float, int, Path]] = []
    suffixes = (CACHE_SUFFIX, PROGRAM_SUFFIX, TRACE_SUFFIX)
    for path in (p for p in folder.iterdir() if p.name.endswith(suffixes)):
        # Another process may be removing the same files.
        with suppress(OSError):
            status = path.stat()
            # Many file systems record at most one reading a day, and some none.
            sizes_by_time.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    total = 0
    for _, size, path in sorted(sizes_by_time, reverse=True):
        total += size
        if total > max_bytes:
            with suppress(OSError):
                path.unlink()
