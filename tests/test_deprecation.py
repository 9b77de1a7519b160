"""Old names work for one release, with a warning that says what replaces them."""

import importlib
import inspect

import pytest
from test_layers import FILES, PACKAGE, imports_of

from smartview_jax import deprecation
from smartview_jax.deprecation import DeprecatedAttribute
from smartview_jax.fit_result import FitCode, FitResult

OLD_NAMES = [
    (package, old, new)
    for package, names in deprecation.NEW_PATHS.items()
    for old, new in names.items()
]

OLD_ATTRIBUTES = {
    ("Calibration", "reported_for"),
    ("CalibrationFit", "estimate"),
    ("CalibrationFit", "freedom"),
    ("CalibrationFit", "margin"),
    ("Dataset", "without"),
    ("FitResult", "require"),
    ("HeldOutErrors", "deviations"),
    ("Influence", "on"),
    ("JointFit", "estimate"),
    ("JointFit", "freedom"),
    ("JointFit", "margin"),
}
"""Some of the old names of attributes, by class; more may follow."""


def deprecated_attributes():
    """The class, the name there and the descriptor of every old attribute in the package."""
    for file in FILES:
        parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
        module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
        for owner in vars(module).values():
            if inspect.isclass(owner) and owner.__module__ == module.__name__:
                for name, value in vars(owner).items():
                    if isinstance(value, DeprecatedAttribute):
                        yield owner, name, value


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
        deviation = DeprecatedAttribute("deviation", "error")

    with pytest.warns(DeprecationWarning, match=r"Fit\.deviation is now Fit\.error;"):
        assert Fit().deviation == 3.0


def test_every_old_attribute_knows_its_name_and_one_that_exists():
    found = list(deprecated_attributes())
    assert {(owner.__name__, name) for owner, name, _ in found} >= OLD_ATTRIBUTES
    for owner, name, attribute in found:
        assert attribute.old_name == name
        # A field without a default is no attribute of its class.
        fields = [field for base in owner.__mro__ for field in inspect.get_annotations(base)]
        assert attribute.new_name in {*dir(owner), *fields}, f"{owner.__name__}.{name}"


def test_a_named_tuple_may_have_an_old_attribute():
    """Python does not tell a descriptor its name there."""
    result = FitResult(FitCode.CONVERGED, "")
    with pytest.warns(DeprecationWarning, match=r"FitResult\.require is now .*\.require_conv"):
        assert result.require() is None


def test_the_package_itself_uses_no_old_name():
    """A name that points upwards would else hide an import from a room above."""
    old_names = {f"smartview_jax.{package}.{old}" for package, old, _ in OLD_NAMES}
    assert not old_names & {name for file in FILES for name in imports_of(file)}
