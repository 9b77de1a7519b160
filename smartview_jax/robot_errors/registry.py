"""Look up robot error fields by the names that files and options use."""

from ..schemas.words import nearest
from .arm_errors import DHErrors, JointOffsets, JointRatios
from .combined import CombinedField
from .field import AbstractField
from .implied_arm import ImpliedArm
from .linear_fields import LinearInPose, LinearInPosition
from .stretch import Stretched

FIELDS: dict[str, type[AbstractField]] = {
    "position": LinearInPosition,
    "pose": LinearInPose,
    "implied_arm": ImpliedArm,
    "joint_offsets": JointOffsets,
    "joint_ratios": JointRatios,
    "dh": DHErrors,
    "stretched": Stretched,
    "combined": CombinedField,
}


def field_by_name(name: str) -> type[AbstractField]:
    """Return the class of a field by its name.

    Raises:
        ValueError: no field has that name.
    """
    if name not in FIELDS:
        raise ValueError(
            f"field is one of {', '.join(FIELDS)}; found {name!r}{nearest(name, FIELDS)}"
        )
    return FIELDS[name]


def field_name(field: AbstractField) -> str:
    """Return the name of a field in `field_by_name`, or else the name of its class."""
    return next(
        (name for name, kind in FIELDS.items() if type(field) is kind), type(field).__name__
    )
