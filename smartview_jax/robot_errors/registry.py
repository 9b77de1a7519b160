"""Look up robot error fields by the names that files and options use."""

from ..schemas.messages import spelling_suggestion
from .arm_errors import DHErrors, JointOffsets, JointRatios
from .combined import CombinedField
from .field import AbstractField
from .generic_six_axis_arm import GenericSixAxisArm
from .linear_fields import LinearInPose, LinearInPosition
from .scale_error import ScaleError

# Files and options contain these names, so a renamed class keeps its entry here.
FIELDS: dict[str, type[AbstractField]] = {
    "position": LinearInPosition,
    "pose": LinearInPose,
    "implied_arm": GenericSixAxisArm,
    "joint_offsets": JointOffsets,
    "joint_ratios": JointRatios,
    "dh": DHErrors,
    "stretched": ScaleError,
    "combined": CombinedField,
}


def field_by_name(name: str) -> type[AbstractField]:
    """Return the class of a field by its name.

    Raises:
        ValueError: no field has that name.
    """
    if name not in FIELDS:
        raise ValueError(
            f"field is one of {', '.join(FIELDS)}; "
            f"found {name!r}{spelling_suggestion(name, FIELDS)}"
        )
    return FIELDS[name]


def field_name(field: AbstractField) -> str:
    """Return the name of a field in `field_by_name`, or else the name of its class."""
    return next(
        (name for name, field_class in FIELDS.items() if type(field) is field_class),
        type(field).__name__,
    )
