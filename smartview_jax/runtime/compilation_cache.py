"""Keep compiled programs on disk, so that later processes read them instead of compiling again.

JAX's persistent compilation cache is switched on when this library first compiles a program, in
the command, a script or a notebook. Only settings that the user has not set are changed:

- the folder, which is `smartview_jax` in $XDG_CACHE_HOME or else in ~/.cache, unless
  JAX_COMPILATION_CACHE_DIR or JAX's own configuration names another;
- the shortest compile time of a program that is kept, which becomes zero, unless
  JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS or JAX's own configuration sets another: a fit has
  many programs that compile in less than JAX's default of one second.

The files of `program_store`, which save the tracing as well, are in the same folder and follow the
same settings.

Anyone who can write a compiled program into the folder can run code as the user. The default folder
is therefore used only if it belongs to the user and nobody else can write to it or replace a folder
above it. In an unsafe folder that the user names, `program_store` keeps nothing. A warning is given
once in both cases.

JAX_ENABLE_COMPILATION_CACHE=0, or `jax.config.update("jax_enable_compilation_cache", False)` before
the first fit, turns it off. Programs of other libraries in the same process are kept, too.
"""

import functools
import os
import stat
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path

import jax

MAX_BYTES = 1_000_000_000
"""Largest total size of the programs in the default folder, bytes; a full calibration needs 20 MB.

JAX can limit the size by itself, but only where the package filelock is installed.
"""

SECONDS_BETWEEN_REMOVALS = 86_400.0
"""Shortest time between two removals of old programs from the default folder, s.

A removal looks at every file, which takes every process a tenth of a second for 9000 files.
"""

LAST_REMOVAL = "last_removal"
"""The name of the empty file whose time is the last removal's."""

CACHE_SUFFIX, PROGRAM_SUFFIX, TRACE_SUFFIX = "-cache", "-program", "-trace"
"""The suffixes of file names: JAX's cache, and the two kinds of files of `program_store`."""

_JAX_MIN_COMPILE_TIME = 1.0
"""JAX's own default of the shortest compile time of a program that is kept, s."""


@functools.cache
def keep_compiled_programs() -> None:
    """Switch on JAX's persistent compilation cache, once per process, unless the user forbids it.

    If the folder is not writable, existing programs are read and none is added.
    """
    settings = jax.config.values
    if not settings["jax_enable_compilation_cache"]:
        return
    chosen = settings["jax_compilation_cache_dir"]
    folder = _default_folder() if chosen is None else chosen
    # An empty text means that the user wants no folder.
    if not folder:
        return
    writable = _is_writable(folder)
    # Network storage has its own kind of owners.
    if "://" not in folder and Path(folder).is_dir() and not is_safe_folder(folder):
        warnings.warn(_why_unsafe(folder), stacklevel=2)
        if chosen is None:
            return
    if chosen is None:
        if not Path(folder).is_dir():
            return
        jax.config.update("jax_compilation_cache_dir", folder)
        if writable and _is_removal_due(Path(folder)):
            _remove_least_recently_used(Path(folder), MAX_BYTES)
    is_default = settings["jax_persistent_cache_min_compile_time_secs"] == _JAX_MIN_COMPILE_TIME
    if is_default and "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        # Otherwise JAX warns for every program that it fails to write.
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
    # JAX writes to network storage with its own library.
    if "://" in folder:
        return True
    try:
        # Compiled programs are run unchecked, so nobody else may write to the folder.
        Path(folder).mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def is_safe_folder(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder exists and only the user or root can put a program there."""
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
    """Return whether a file or folder is the user's or root's and nobody else may write to it."""
    if not hasattr(os, "geteuid"):
        return True  # Windows protects a user's profile from other users.
    status = path.stat()
    by_others = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    return status.st_uid in (0, os.geteuid()) and not by_others


def _can_be_exchanged_in(parent: os.stat_result) -> bool:
    """Return whether another user could replace an entry of a folder."""
    if not hasattr(os, "geteuid"):
        return False
    is_others = parent.st_uid not in (0, os.geteuid())
    # In a sticky folder, such as /tmp, only the owner of an entry may rename it.
    is_open = parent.st_mode & stat.S_IWOTH and not parent.st_mode & stat.S_ISVTX
    return bool(is_others or is_open)


def _why_unsafe(folder: str) -> str:
    """Return the warning about an unsafe folder, with the remedy."""
    return (
        f"compiled programs are not kept in {folder}: another user could put programs there that "
        "would run as you. Expected a folder that belongs to you and that nobody else can write "
        "to, within folders that nobody else can rename: run chmod go-w on it, or name another "
        "folder in JAX_COMPILATION_CACHE_DIR"
    )


def _is_removal_due(folder: Path) -> bool:
    """Return whether old programs were not removed for a day, and note that they are now."""
    mark = folder / LAST_REMOVAL
    with suppress(OSError):
        # A clock that was set back leaves a time in the future.
        if abs(time.time() - mark.stat().st_mtime) < SECONDS_BETWEEN_REMOVALS:
            return False
    with suppress(OSError):
        mark.touch()
    return True


def _remove_least_recently_used(folder: Path, max_bytes: int) -> None:
    """Remove the least recently read programs until the rest is small enough."""
    sizes_by_time: list[tuple[float, int, str]] = []
    suffixes = (CACHE_SUFFIX, PROGRAM_SUFFIX, TRACE_SUFFIX)
    # There are thousands of files, which take pathlib five times as long.
    with os.scandir(folder) as entries:
        for entry in entries:
            if not entry.name.endswith(suffixes):
                continue
            # Another process may be removing the same files.
            with suppress(OSError):
                status = entry.stat()
                # Many file systems record at most one read per day, and some record none.
                last_use = max(status.st_atime, status.st_mtime)
                sizes_by_time.append((last_use, status.st_size, entry.path))
    total = 0
    for _, size, path in sorted(sizes_by_time, reverse=True):
        total += size
        if total > max_bytes:
            with suppress(OSError):
                Path(path).unlink()
