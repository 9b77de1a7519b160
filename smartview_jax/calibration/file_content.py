"""Write a calibration as plain numbers with names and units, and read it again.

This is what its YAML and JSON files contain.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..argument_checks import require_readable
from ..cameras import AbstractLens, camera_from_dict, camera_to_dict
from ..geometry import region_from_dict, region_to_dict, transform_from_dict, transform_to_dict
from ..robot_errors import AbstractField, robot_error_from_dict, robot_error_to_dict
from .chain import BASES, transform_names
from .depth_bias import DepthBias
from .target_shape import shape_from_dict, shape_to_dict

if TYPE_CHECKING:
    from .calibration import Calibration

FORMAT_VERSION = 2
"""Version of the file format.

Files of version 1 have no end mark; `schemas.calibration` defines which of them load."""

_END_MARK = "smartview_calibration"
"""Value of the last entry of a file, by which a truncated file is recognised."""


def content_of(
    calibration: "Calibration",
    run: str | None = None,
    warnings: Sequence[str] = (),
    *,
    source: str | None = None,
    uncertainty: Mapping[str, Any] | None = None,
    pictures: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what the file of a calibration contains; arguments as in `Calibration.save`."""
    if run is not None:
        require_readable("run", [run])
    content: dict[str, Any] = {
        "smartview_calibration": FORMAT_VERSION,
        **({} if run is None else {"run": run}),
        **({} if source is None else {"source": source}),
        **({"warnings": list(warnings)} if warnings else {}),
        "units": {"length": "m", "angle": "rad", "image": "px"},
        "mount": calibration.mount,
        "camera": camera_to_dict(calibration.camera),
    }
    for name, transform in calibration.transforms.items():
        content[name] = transform_to_dict(transform)
    content["target_scale"] = float(calibration.target_scale)
    if calibration.target_shape is not None:
        content["target_shape"] = shape_to_dict(calibration.target_shape)
    if (bias := calibration.depth_bias) is not None:
        content["depth_bias"] = {"scale": float(bias.scale), "offset": float(bias.offset)}
    error = calibration.robot_error
    content["robot_error"] = None if error is None else robot_error_to_dict(error)
    if calibration.region is not None:
        content["region"] = region_to_dict(calibration.region)
    if pictures:
        content["pictures"] = list(pictures)
    if uncertainty is not None:
        content["uncertainty"] = dict(uncertainty)
    # Last on purpose: a truncated file can still be valid YAML, but it has no end mark.
    content["end"] = _END_MARK
    return content


def parts_of(
    content: dict[Any, Any], lens: AbstractLens | None = None, field: AbstractField | None = None
) -> dict[str, Any]:
    """Return the arguments from which a `Calibration` is made, after checking all entries.

    Args:
        content: what `content_of` returns.
        lens: a lens of a user-defined class; its numbers are read from `content`.
        field: a robot error field of a user-defined class; its numbers are read from `content`.

    Raises:
        ValueError: naming the entry that is missing or wrong.
    """
    # The validation library is imported only where files are read; fits do not need it.
    from ..schemas.calibration import CALIBRATION_SCHEMA
    from ..schemas.validation import validate_content

    validate_content(content, CALIBRATION_SCHEMA)
    # The file uses the public names, which depend on the mount.
    camera_from_mount, holder_from_world = (
        transform_from_dict(name, content[name]) for name in transform_names(content["mount"])
    )
    is_between_hands = content["mount"] == "hand_to_hand"
    bases = transform_from_dict(BASES, content[BASES]) if is_between_hands else None
    error, region = content.get("robot_error"), content.get("region")
    shape, bias = content.get("target_shape"), content.get("depth_bias")
    return {
        "camera": camera_from_dict(content["camera"], lens),
        "camera_from_mount": camera_from_mount,
        "holder_from_world": holder_from_world,
        "mount": content["mount"],
        "target_scale": float(content["target_scale"]),
        "robot_error": None if error is None else robot_error_from_dict(error, field),
        "region": None if region is None else region_from_dict(region),
        "target_shape": None if shape is None else shape_from_dict(shape),
        "depth_bias": None if bias is None else DepthBias(bias["scale"], bias["offset"]),
        "base_from_other_base": bases,
    }
