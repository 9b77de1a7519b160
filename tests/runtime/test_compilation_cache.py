"""Compiled programs are kept between processes, by settings of JAX that the user left alone.

What a second process then reads is in test_program_store.py.
"""

import os
import types
import warnings

import jax
import numpy as np
import pytest

from smartview_jax.runtime import compilation_cache
from smartview_jax.runtime.compilation import compiled

SETTINGS = {
    "jax_enable_compilation_cache": True,
    "jax_compilation_cache_dir": None,
    "jax_persistent_cache_min_compile_time_secs": 1.0,
}
"""What JAX has by itself."""

VARIABLES = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")


@pytest.fixture
def settings(tmp_path, monkeypatch):
    """Switches the cache on in a process where JAX is as it comes, or has the given settings."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    before = {name: getattr(jax.config, name) for name in SETTINGS}

    def switch_on(**given):
        for name, value in {**SETTINGS, **given}.items():
            jax.config.update(name, value)
        compilation_cache.keep_compiled_programs.__wrapped__()
        return jax.config.jax_compilation_cache_dir, (
            jax.config.jax_persistent_cache_min_compile_time_secs
        )

    yield switch_on
    for name, value in before.items():
        jax.config.update(name, value)


def test_by_default_all_programs_are_kept_in_one_folder(settings, tmp_path):
    assert settings() == (str(tmp_path / "smartview_jax"), 0.0)
    assert (tmp_path / "smartview_jax").stat().st_mode & 0o777 == 0o700


def test_settings_of_the_user_stay(settings, tmp_path, monkeypatch):
    mine = str(tmp_path / "mine")
    folder, shortest = (
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
    )
    assert settings(**{folder: mine}) == (mine, 0.0)
    assert settings(**{folder: mine, shortest: 0.2}) == (mine, 0.2)
    assert settings(**{shortest: 5.0})[1] == 5.0
    assert settings(**{folder: ""}) == ("", 1.0)
    assert settings(jax_enable_compilation_cache=False) == (None, 1.0)
    # The same number as JAX's own, but said by the user.
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1")
    assert settings()[1] == 1.0


def test_without_a_home_nothing_is_kept(settings, monkeypatch):
    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr("pathlib.Path.home", homeless)
    assert settings() == (None, 1.0)


@pytest.mark.parametrize("chosen", [False, True])
def test_a_folder_that_cannot_be_written_is_no_error_and_no_warning(settings, tmp_path, chosen):
    (tmp_path / "smartview_jax").write_text("a file, not a folder")
    with warnings.catch_warnings(action="error"):
        folder, shortest = settings(
            jax_compilation_cache_dir=str(tmp_path / "smartview_jax") if chosen else None
        )
    if chosen:
        assert shortest == float("inf")
    else:
        assert (folder, shortest) == (None, 1.0)


def test_a_read_only_folder_is_read(settings, tmp_path, monkeypatch):
    """As it may be where somebody else made it; root, who runs some tests, can write anywhere."""
    (tmp_path / "smartview_jax").mkdir()

    def refused(**_):
        raise PermissionError("read-only")

    monkeypatch.setattr("tempfile.TemporaryFile", refused)
    assert settings() == (str(tmp_path / "smartview_jax"), float("inf"))


UNSAFE = {
    "open": lambda folder: folder.chmod(0o777),
    "open to its group": lambda folder: folder.chmod(0o775),
    "in an open folder": lambda folder: folder.parent.chmod(0o777),
}


@pytest.mark.parametrize("make_unsafe", UNSAFE.values(), ids=UNSAFE)
@pytest.mark.parametrize("chosen", [False, True])
def test_a_folder_that_others_can_write_is_refused(settings, tmp_path, chosen, make_unsafe):
    folder = tmp_path / "smartview_jax"
    folder.mkdir(mode=0o755)
    assert compilation_cache.is_safe_folder(folder)
    make_unsafe(folder)
    with pytest.warns(UserWarning, match="another user could put programs there"):
        found, _ = settings(jax_compilation_cache_dir=str(folder) if chosen else None)
    # What the user names for JAX is JAX's; this library's own programs are not kept there.
    assert found == (str(folder) if chosen else None)
    assert not compilation_cache.is_safe_folder(folder)


def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    """By root, too, who may write anywhere; what root made is safe for everybody."""

    def owned_by(uid):
        return types.SimpleNamespace(st_uid=uid, st_mode=0o40755)

    def is_safe(owner, user):
        monkeypatch.setattr("os.geteuid", lambda: user)
        monkeypatch.setattr("pathlib.Path.stat", lambda *_, **__: owned_by(owner))
        return compilation_cache.only_user_can_write(tmp_path)

    assert [is_safe(1000, 0), is_safe(1000, 1001)] == [False, False]
    assert [is_safe(0, 1000), is_safe(1000, 1000), is_safe(0, 0)] == [True, True, True]


def test_what_was_not_read_for_longest_is_removed_once_a_day(settings, tmp_path, monkeypatch):
    folder = tmp_path / "smartview_jax"
    folder.mkdir()
    for day, name in enumerate(("old-cache", "middle-cache", "new-cache", "mine.txt")):
        (folder / name).write_bytes(b"x" * 100)
        os.utime(folder / name, (86400.0 * day, 0.0))
    mark = folder / compilation_cache.LAST_REMOVAL
    settings()
    assert len(list(folder.iterdir())) == 5
    monkeypatch.setattr(compilation_cache, "MAX_BYTES", 250)
    mark.unlink()
    settings(jax_compilation_cache_dir=str(folder))
    assert len(list(folder.iterdir())) == 4, "a folder of the user's was emptied"
    mark.touch()
    settings()
    assert len(list(folder.iterdir())) == 5, "every process looked at every file"
    os.utime(mark, (0.0, 0.0))
    settings()
    rest = {"middle-cache", "new-cache", "mine.txt", mark.name}
    assert {path.name for path in folder.iterdir()} == rest


def test_the_first_program_switches_the_cache_on(monkeypatch):
    calls = []
    monkeypatch.setattr(
        "smartview_jax.runtime.compilation.keep_compiled_programs", lambda: calls.append(1)
    )
    program = compiled(lambda x: x + 1.0)
    assert not calls
    program(np.zeros(3))
    assert calls
