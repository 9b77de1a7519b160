"""Old names work for one release, with a warning that says what replaces them."""

import importlib

import pytest
from test_layers import FILES, imports_of

from smartview_jax import deprecation
from smartview_jax.deprecation import DeprecatedAttribute

OLD_NAMES = [
    (package, old, new)
    for package, names in deprecation.NEW_PATHS.items()
    for old, new in names.items()
]


@pytest.mark.parametrize(("package", "old", "new"), OLD_NAMES)
def test_an_old_name_gives_what_replaces_it(package, old, new):
    room, _, name = f"smartview_jax.{new}".rpartition(".")
    with pytest.warns(DeprecationWarning, match=rf"{package}\.{old} is now {room}\.{name};"):
        found = getattr(importlib.import_module(f"smartview_jax.{package}"), old)
    assert found is getattr(importlib.import_module(room), name)


@pytest.mark.parametrize("package", deprecation.NEW_PATHS)
def test_a_name_that_never_was_is_an_attribute_error(package):
    module = importlib.import_module(f"smartview_jax.{package}")
    with pytest.raises(AttributeError, match=f"'smartview_jax.{package}' has no attribute 'never'"):
        _ = module.never


def test_an_old_attribute_gives_what_replaces_it():
    class Fit:
        error = 3.0
        deviation = DeprecatedAttribute("error")

    with pytest.warns(DeprecationWarning, match=r"Fit\.deviation is now Fit\.error;"):
        assert Fit().deviation == 3.0


def test_the_package_itself_uses_no_old_name():
    """A name that points upwards would else hide an import from a room above."""
    old_names = {f"smartview_jax.{package}.{old}" for package, old, _ in OLD_NAMES}
    assert not old_names & {name for file in FILES for name in imports_of(file)}
