"""Create Equinox modules from their fields at once.

`dataclasses.replace` and `equinox.tree_at` run the constructor with its checks or take the whole
tree apart. That takes 0.1 to 1 ms, and a small calibration changes a field a hundred times.
"""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx

_Module = TypeVar("_Module", bound=eqx.Module)


def module_of(module_class: type[_Module], fields: dict[str, Any]) -> _Module:
    """Create a module from its fields, as Equinox's own unflattening does, without checks."""
    module = object.__new__(module_class)
    for name, value in fields.items():
        object.__setattr__(module, name, value)
    return module


def with_fields(module: _Module, **changes: Any) -> _Module:
    """Return a module with some fields changed; nothing checks the new values.

    Raises:
        TypeError: the module has no such field.
    """
    fields = vars(module)
    if unknown := changes.keys() - fields.keys():
        raise TypeError(f"{type(module).__name__} has no field {', '.join(sorted(unknown))}")
    return module_of(type(module), fields | changes)


def fields_of(value: Any, base: type) -> dict[str, Any]:
    """Return those fields of a dataclass's instance that a base of its class has, by name."""
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(base)}


class HostModule(eqx.Module):
    """An Equinox module whose methods are plain methods rather than pytrees.

    Equinox makes each method that is looked up a module of its own, so that a method can be an
    argument of a compiled function. That takes 17 microseconds each time, and a small calibration
    calls methods of its data two hundred times. A method of such a module cannot be such an
    argument; the module itself can.
    """

    __getattribute__ = object.__getattribute__
