"""Convert an arm to and from plain numbers with names, the form in which files store it."""

from typing import Any

import numpy as np

from ..geometry import transform_from_dict, transform_to_dict
from .serial_arm import SerialArm

_DH_PARAMETERS = ("theta", "d", "a", "alpha")


def arm_to_dict(arm: SerialArm) -> dict[str, Any]:
    """Return the Denavit-Hartenberg parameters of an arm as lists by name, in rad and m."""
    return {
        "convention": arm.convention,
        "prismatic": list(arm.prismatic),
        **{name: np.asarray(getattr(arm, name)).tolist() for name in _DH_PARAMETERS},
        "flange_from_tool": transform_to_dict(arm.flange_from_tool),
        "base_from_first": transform_to_dict(arm.base_from_first),
        # JSON has no infinity: a limit that does not exist is null.
        "limits": [
            [bound if np.isfinite(bound) else None for bound in row]
            for row in np.asarray(arm.limits).tolist()
        ],
    }


def arm_from_dict(content: dict[str, Any]) -> SerialArm:
    """Return the arm that `arm_to_dict` converted to plain numbers.

    Only the parameters and their convention are required. By default joints are revolute without
    limits, the tool is the flange, and the first axis is the base's z axis.

    Raises:
        ValueError: the content does not describe an arm.
        KeyError: an entry is missing.
    """
    tool, first = (
        None if content.get(name) is None else transform_from_dict(name, content[name])
        for name in ("flange_from_tool", "base_from_first")
    )
    return SerialArm(
        **{name: np.asarray(content[name], dtype=float) for name in _DH_PARAMETERS},
        convention=content["convention"],
        prismatic=content.get("prismatic"),
        limits=_limits_from_plain(content.get("limits")),
        flange_from_tool=tool,
        base_from_first=first,
    )


def _limits_from_plain(rows: list[list[float | None]] | None) -> np.ndarray | None:
    """Return joint limits as an array, infinite where the file has null."""
    if rows is None:
        return None
    unbounded = (-np.inf, np.inf)
    return np.array(
        [
            [
                default if bound is None else bound
                for bound, default in zip(row, unbounded, strict=True)
            ]
            for row in rows
        ],
        dtype=float,
    )
