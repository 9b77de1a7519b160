"""Provide robot arms by name or from files, by their nominal Denavit-Hartenberg parameters.

The paper's PUMA 761 is missing, and so is the 762: no source for their link lengths was found.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..argument_checks import require_one_of
from ..files import finite_or_null
from ..geometry import transform_from_dict, transform_to_dict
from .serial_arm import SerialArm

_RIGHT_ANGLE = 0.5 * np.pi

_DH_PARAMETERS = ("theta", "d", "a", "alpha")


def kuka_lwr4() -> SerialArm:
    """Return the KUKA LWR 4+, a seven-joint arm, from its base to its flange.

    Lengths are from its data sheet (0.31, 0.40, 0.39, 0.078 m between shoulder, elbow, wrist and
    flange). They reproduce the poses that the controller of one such arm reported to 0.15 mm and
    0.01 degrees. Limits are from `lwr_description` in CentroEPiaggio/kuka-lwr, the arm's ROS
    package.
    """
    return SerialArm(
        theta=np.zeros(7),
        d=[0.31, 0.0, 0.40, 0.0, 0.39, 0.0, 0.078],
        a=np.zeros(7),
        alpha=[
            _RIGHT_ANGLE,
            -_RIGHT_ANGLE,
            -_RIGHT_ANGLE,
            _RIGHT_ANGLE,
            _RIGHT_ANGLE,
            -_RIGHT_ANGLE,
            0.0,
        ],
        limits=np.deg2rad([[-170, 170], [-120, 120]] * 3 + [[-170, 170]]),
    )


def six_axes() -> SerialArm:
    """Return a generic vertical six-axis arm with a reach of 1.4 m, for simulations.

    It is no manufacturer's model.
    """
    return SerialArm(
        theta=[0.0, -_RIGHT_ANGLE, 0.0, 0.0, 0.0, 0.0],
        d=[0.400, 0.0, 0.0, 0.640, 0.0, 0.115],
        a=[0.150, 0.600, 0.120, 0.0, 0.0, 0.0],
        alpha=[-_RIGHT_ANGLE, 0.0, -_RIGHT_ANGLE, _RIGHT_ANGLE, -_RIGHT_ANGLE, 0.0],
    )


def puma_560() -> SerialArm:
    """Return the Unimation PUMA 560 in the convention of Paul and Corke, from shoulder to flange.

    With all joints at zero the arm is in its right-handed configuration.

    Lengths: Corke and Armstrong-Helouvry, A search for consensus among model parameters reported
    for the PUMA 560 robot, ICRA 1994; link twists have Paul's signs. Limits: Corke's Robotics
    Toolbox, after Wang and Chen, IEEE Trans. RA 7(4), 1991. The origin is VAL's, in the shoulder;
    the floor under a pedestal of 26.45 inches is 0.67183 m below (`base_from_first`).
    """
    return SerialArm(
        theta=np.zeros(6),
        d=[0.0, 0.0, 0.15005, 0.4318, 0.0, 0.0],
        a=[0.0, 0.4318, 0.0203, 0.0, 0.0, 0.0],
        alpha=[_RIGHT_ANGLE, 0.0, -_RIGHT_ANGLE, _RIGHT_ANGLE, -_RIGHT_ANGLE, 0.0],
        limits=np.deg2rad(
            [[-160, 160], [-45, 225], [-225, 45], [-110, 170], [-100, 100], [-266, 266]]
        ),
    )


def puma_560_lee() -> SerialArm:
    """Return the Unimation PUMA 560 in the convention of Lee, from shoulder to flange end.

    With all joints at zero the arm is in its left-handed configuration.

    C. S. G. Lee, Robot arm kinematics, dynamics and control, Computer 15(12), 1982; Fu, Gonzalez
    and Lee, Robotics, 1987, figure 2.11, limits included. With the same lengths it equals
    `puma_560`:

        joints of puma_560 = joints of puma_560_lee + (pi, pi, -pi, 0, 0, pi)

    with `a3` of the opposite sign and Lee's `d2` instead of Corke's `d3`. The lengths differ by up
    to 1.3 mm, because they were measured on two arms, and Lee's `d6` extends to the end of the
    flange. The limits of joints 1 and 6 are each author's own; they do not agree after the
    half-revolution offset between the two conventions.
    """
    return SerialArm(
        theta=np.zeros(6),
        d=[0.0, 0.14909, 0.0, 0.43307, 0.0, 0.05625],
        a=[0.0, 0.4318, -0.02032, 0.0, 0.0, 0.0],
        alpha=[-_RIGHT_ANGLE, 0.0, _RIGHT_ANGLE, -_RIGHT_ANGLE, _RIGHT_ANGLE, 0.0],
        limits=np.deg2rad(
            [[-160, 160], [-225, 45], [-45, 225], [-110, 170], [-100, 100], [-266, 266]]
        ),
    )


ARMS: dict[str, Callable[[], SerialArm]] = {
    # Functions, not arms: an arm holds JAX arrays, which are only created when one is needed.
    "kuka_lwr4": kuka_lwr4,
    "six_axes": six_axes,
    "puma_560": puma_560,
    "puma_560_lee": puma_560_lee,
}


def arm_by_name(name: str) -> SerialArm:
    """Return a nominal arm by its name; a ValueError if there is none."""
    require_one_of("arm", name, ARMS, ", or its parameters")
    return ARMS[name]()


def arm_to_dict(arm: SerialArm) -> dict[str, Any]:
    """Return the Denavit-Hartenberg parameters of an arm as lists by name, in rad and m."""
    return {
        "convention": arm.convention,
        "prismatic": list(arm.prismatic),
        **{name: np.asarray(getattr(arm, name)).tolist() for name in _DH_PARAMETERS},
        "flange_from_tool": transform_to_dict(arm.flange_from_tool),
        "base_from_first": transform_to_dict(arm.base_from_first),
        "limits": [list(map(finite_or_null, row)) for row in np.asarray(arm.limits).tolist()],
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
    # NumPy reads None as NaN.
    limits = np.array(rows, dtype=float).reshape(len(rows), 2)
    return np.where(np.isnan(limits), [-np.inf, np.inf], limits)
