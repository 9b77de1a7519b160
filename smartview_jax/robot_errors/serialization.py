"""Convert a robot error to and from plain numbers with names, the form in which files store it."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..robots import SerialArm, arm_from_dict, arm_to_dict
from ..schemas.words import nearest, shown
from .field import AbstractField
from .registry import field_by_name, field_name
from .robot_error import RobotError


def robot_error_to_dict(error: RobotError) -> dict[str, Any]:
    """Return a robot error with every coefficient by name, readable without this library."""
    coefficients = np.asarray(error.coefficients).tolist()
    return {
        "field": _field_to_dict(error.field),
        "coefficients": dict(zip(error.field.names, coefficients, strict=True)),
    }


def _field_to_dict(field: AbstractField) -> dict[str, Any]:
    """Return the attributes of a field by name, with the name of its model."""
    # All attributes are written, so that a field of the caller's own needs no code for files.
    parts = {name: _part_to_plain(value) for name, value in vars(field).items()}
    return {"model": field_name(field), **parts}


def _part_to_plain(part: Any) -> Any:
    """Return an attribute of a field as plain numbers: a field, an arm or an array."""
    if isinstance(part, AbstractField):
        return _field_to_dict(part)
    return arm_to_dict(part) if isinstance(part, SerialArm) else np.asarray(part).tolist()


def robot_error_from_dict(content: dict[str, Any], field: AbstractField | None) -> RobotError:
    """Return the robot error that `robot_error_to_dict` converted to plain numbers.

    Args:
        content: the plain numbers.
        field: an instance of the same class, for a field that the library does not know.

    Raises:
        ValueError: the numbers are not those of the field.
        KeyError: an entry is missing.
    """
    basis = _field_from_dict(content["field"], field)
    given = content["coefficients"]
    if set(given) != set(basis.names):
        raise ValueError(f"robot_error.coefficients: {_differences(given, basis.names)}")
    return RobotError(basis, jnp.array([float(given[name]) for name in basis.names]))


def _field_from_dict(content: dict[str, Any], field: AbstractField | None) -> AbstractField:
    """Return a field from its attributes by name, after a check of their types."""
    parts = dict(content)
    model = parts.pop("model")
    kind = field_by_name(model) if field is None else type(field)
    kinds: dict[str, Any] = {part.name: part.type for part in dataclasses.fields(kind)}
    if set(parts) != set(kinds):
        raise ValueError(f"robot_error.field: {_differences(parts, kinds)}")

    def part(name: str, value: Any) -> Any:
        if isinstance(value, dict) and "model" in value:
            return _field_from_dict(value, getattr(field, name, None))
        return arm_from_dict(value) if isinstance(value, dict) else jnp.asarray(value, dtype=float)

    made = {name: part(name, value) for name, value in parts.items()}
    for name, value in made.items():
        # Annotations are jaxtyping array types or classes; `isinstance` checks shapes of the
        # former.
        if not isinstance(value, kinds[name]):
            raise ValueError(
                f"robot_error.field.{name}: expected {kinds[name].__name__}, "
                f"found {shown(parts[name])}"
            )
    return kind(**made)


def _differences(found: Iterable[str], known: Iterable[str]) -> str:
    """Return which names are missing and which are unknown, with their closest match."""
    missing = [name for name in known if name not in found]
    unknown = [f"{shown(name)}{nearest(name, missing)}" for name in found if name not in known]
    return "; ".join(
        f"{words} {', '.join(names[:5])}{' and more' * (len(names) > 5)}"
        for words, names in (("missing are", missing), ("of no use are", unknown))
        if names
    )
