"""Convert a robot error to and from plain numbers with names, the form in which files store it."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..argument_checks import require_one_of, shortened_repr, spelling_suggestion
from ..robots import SerialArm, arm_from_dict, arm_to_dict
from ..runtime.array_namespace import as_float_array
from .arm_errors import DHErrors, ElasticDHErrors, JointOffsets, JointRatios
from .combined import CombinedField
from .common_errors import ErrorsOfType
from .field import AbstractField
from .generic_six_axis_arm import GenericSixAxisArm
from .linear_fields import LinearInPose, LinearInPosition, QuadraticInPosition, SmoothInPose
from .robot_error import RobotError
from .scale_error import ScaleError

FIELDS: dict[str, type[AbstractField]] = {
    "position": LinearInPosition,
    "pose": LinearInPose,
    "position_squared": QuadraticInPosition,
    "pose_squared": SmoothInPose,
    "six_axis_arm": GenericSixAxisArm,
    "joint_offsets": JointOffsets,
    "joint_ratios": JointRatios,
    "dh": DHErrors,
    "elastic_dh": ElasticDHErrors,
    "scale_error": ScaleError,
    "combined": CombinedField,
    "errors_of_type": ErrorsOfType,
}

OLD_NAMES = {"implied_arm": "six_axis_arm", "stretched": "scale_error"}
"""Names that calibration files of earlier versions contain, with today's."""


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
    attributes = {name: _attribute_to_plain(value) for name, value in vars(field).items()}
    return {"model": field_name(field), **attributes}


def _attribute_to_plain(attribute: Any) -> Any:
    """Return an attribute of a field as plain numbers: a field, an arm or an array."""
    if isinstance(attribute, AbstractField):
        return _field_to_dict(attribute)
    return (
        arm_to_dict(attribute)
        if isinstance(attribute, SerialArm)
        else np.asarray(attribute).tolist()
    )


def robot_error_from_dict(content: dict[str, Any], field: AbstractField | None) -> RobotError:
    """Return the robot error that `robot_error_to_dict` converted to plain numbers.

    Args:
        content: the plain numbers.
        field: an instance of the same class, for a field that the library does not know.

    Raises:
        ValueError: the names of the numbers are not the field's names.
        KeyError: an entry is missing.
    """
    restored = _field_from_dict(content["field"], field)
    coefficients = content["coefficients"]
    if set(coefficients) != set(restored.names):
        raise ValueError(f"robot_error.coefficients: {_differences(coefficients, restored.names)}")
    values = [float(coefficients[name]) for name in restored.names]
    return RobotError(restored, as_float_array(values))


def _field_from_dict(content: dict[str, Any], field: AbstractField | None) -> AbstractField:
    """Return a field from its attributes by name, after a check of their types."""
    attributes = dict(content)
    model = attributes.pop("model")
    field_class = field_by_name(model) if field is None else type(field)
    attribute_types: dict[str, Any] = {
        attribute.name: attribute.type for attribute in dataclasses.fields(field_class)
    }
    if set(attributes) != set(attribute_types):
        raise ValueError(f"robot_error.field: {_differences(attributes, attribute_types)}")

    def attribute_from_plain(name: str, value: Any) -> Any:
        # A nested field is recognised by its model; any other mapping is an arm.
        if isinstance(value, dict) and "model" in value:
            return _field_from_dict(value, getattr(field, name, None))
        return arm_from_dict(value) if isinstance(value, dict) else as_float_array(value)

    converted = {name: attribute_from_plain(name, value) for name, value in attributes.items()}
    for name, value in converted.items():
        # Annotations are jaxtyping array types or classes; `isinstance` checks shapes of the
        # former.
        if not isinstance(value, attribute_types[name]):
            raise ValueError(
                f"robot_error.field.{name}: expected {attribute_types[name].__name__}, "
                f"found {shortened_repr(attributes[name])}"
            )
    return field_class(**converted)


def _differences(names: Iterable[str], known: Iterable[str]) -> str:
    """Return which names are missing and which are unknown, with their closest match."""
    missing = [name for name in known if name not in names]
    unknown = [
        f"{shortened_repr(name)}{spelling_suggestion(name, missing)}"
        for name in names
        if name not in known
    ]
    return "; ".join(
        f"{words} {', '.join(names[:5])}{' and more' * (len(names) > 5)}"
        for words, names in (("missing", missing), ("unknown", unknown))
        if names
    )


def field_by_name(name: str) -> type[AbstractField]:
    """Return the class of a field by its name.

    Raises:
        ValueError: no field has that name.
    """
    name = OLD_NAMES.get(name, name)
    require_one_of("field", name, FIELDS)
    return FIELDS[name]


def field_name(field: AbstractField) -> str:
    """Return the name of a field in `field_by_name`, or else the name of its class."""
    return next(
        (name for name, field_class in FIELDS.items() if type(field) is field_class),
        type(field).__name__,
    )
