"""Look up robot error fields by the names that files and options use."""

from ..argument_checks import require_one_of
from .arm_errors import DHErrors, JointOffsets, JointRatios
from .combined import CombinedField
from .field import AbstractField
from .generic_six_axis_arm import GenericSixAxisArm
from .linear_fields import LinearInPose, LinearInPosition
from .scale_error import ScaleError

FIELDS: dict[str, type[AbstractField]] = {
    "position": LinearInPosition,
    "pose": LinearInPose,
    "six_axis_arm": GenericSixAxisArm,
    "joint_offsets": JointOffsets,
    "joint_ratios": JointRatios,
    "dh": DHErrors,
    "scale_error": ScaleError,
    "combined": CombinedField,
}

OLD_NAMES = {"implied_arm": "six_axis_arm", "stretched": "scale_error"}
"""Names that calibration files of earlier versions contain, with today's."""


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
