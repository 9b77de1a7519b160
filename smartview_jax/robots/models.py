"""Arms by name, with nominal Denavit-Hartenberg numbers and where they are from."""

from collections.abc import Callable

import numpy as np

from .serial_arm import SerialArm

_RIGHT = 0.5 * np.pi


def kuka_lwr4() -> SerialArm:
    """KUKA LWR 4+, seven joints, base to flange.

    Lengths of its data sheet (0.31, 0.40, 0.39, 0.078 m between shoulder, elbow, wrist and flange).
    They give the poses that the controller of one such arm reported to 0.15 mm and 0.01 degrees.
    """
    return SerialArm(
        theta=np.zeros(7),
        d=[0.31, 0.0, 0.40, 0.0, 0.39, 0.0, 0.078],
        a=np.zeros(7),
        alpha=[_RIGHT, -_RIGHT, -_RIGHT, _RIGHT, _RIGHT, -_RIGHT, 0.0],
    )


def six_axes() -> SerialArm:
    """No maker's: a vertical six-axis arm with a reach of 1.4 m, for simulations."""
    return SerialArm(
        theta=[0.0, -_RIGHT, 0.0, 0.0, 0.0, 0.0],
        d=[0.400, 0.0, 0.0, 0.640, 0.0, 0.115],
        a=[0.150, 0.600, 0.120, 0.0, 0.0, 0.0],
        alpha=[-_RIGHT, 0.0, -_RIGHT, _RIGHT, -_RIGHT, 0.0],
    )


ARMS: dict[str, Callable[[], SerialArm]] = {"kuka_lwr4": kuka_lwr4, "six_axes": six_axes}


def arm_by_name(name: str) -> SerialArm:
    """A nominal arm.

    Raises:
        ValueError: no arm is called so.
    """
    if name not in ARMS:
        raise ValueError(f"arm is one of {', '.join(ARMS)}, or its numbers; found {name!r}")
    return ARMS[name]()
