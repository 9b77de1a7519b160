"""Denavit-Hartenberg numbers of a chain whose axes are known where all its joints read zero.

Each link's frame lies on the common normal of an axis and the next: z along the axis, x along the
normal, so that `standard` numbers take one to the other exactly. Where two axes meet, x is at right
angles to both; where they are parallel any normal will do, and the one at the last frame's origin
is taken, so that `d` is zero.

Source: Denavit and Hartenberg, A kinematic notation for lower-pair mechanisms, 1955.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from .serial_arm import SerialArm

PARALLEL = 1e-9
"""Sine of the angle between axes below which they are taken to be parallel."""


def arm_from_axes(
    points: Float[np.ndarray, "joints 3"],
    directions: Float[np.ndarray, "joints 3"],
    base_from_tool: Float[np.ndarray, "4 4"],
    prismatic: Sequence[bool] | None = None,
    limits: Float[np.ndarray, "joints 2"] | None = None,
) -> SerialArm:
    """The arm whose joints turn about, or slide along, given axes.

    Args:
        points: on each axis in the base's frame where all joints read zero, m.
        directions: of each; their length does not matter.
        base_from_tool: where the tool then is.
        prismatic: which joints slide.
        limits: of the readings, rad or m.

    Raises:
        ValueError: an axis without a direction; the message counts joints from one.
    """
    lengths = np.linalg.norm(directions, axis=1)
    for k in np.flatnonzero(~(lengths > 0.0)):
        raise ValueError(f"joint {1 + k}: the axis has no direction")
    directions = directions / lengths[:, None]
    first = frame = _frame(points[0], directions[0], _across(directions[0]))
    rows = []
    for k in range(1, len(points)):
        foot, x, length = _common_normal(frame, points[k], directions[k])
        theta = np.arctan2(x @ frame[:3, 1], x @ frame[:3, 0])
        d = (foot - frame[:3, 3]) @ frame[:3, 2]
        sine = np.cross(frame[:3, 2], directions[k]) @ x
        alpha = np.arctan2(sine, frame[:3, 2] @ directions[k])
        rows.append((theta, d, length, alpha))
        frame = _frame(foot + length * x, directions[k], x)
    theta, d, a, alpha = np.array([*rows, (0.0, 0.0, 0.0, 0.0)]).T
    return SerialArm(
        theta,
        d,
        a,
        alpha,
        prismatic=prismatic,
        limits=limits,
        base_from_first=_pose(first),
        flange_from_tool=_pose(np.linalg.inv(frame) @ base_from_tool),
    )


def _common_normal(
    frame: Float[np.ndarray, "4 4"], point: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Its foot on a frame's z axis, its direction, and its length to another axis; not negative."""
    z, way = frame[:3, 2], point - frame[:3, 3]
    across = np.cross(z, axis)
    sine = np.linalg.norm(across)
    if sine < PARALLEL:
        between = way - (way @ z) * z
        length = np.linalg.norm(between)
        x = between / length if length > PARALLEL else frame[:3, 0]
        return frame[:3, 3], x, float(length)
    x = across / sine
    foot = frame[:3, 3] + (np.cross(way, axis) @ across / sine**2) * z
    length = way @ x
    # On an axis that the other meets, the sign of nothing decides nothing.
    return (foot, x, float(length)) if length >= 0.0 else (foot, -x, float(-length))


def _across(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A direction at right angles: the base's x where that is one."""
    other = np.eye(3)[0 if abs(axis[0]) < 0.9 else 1]
    x = other - (other @ axis) * axis
    return x / np.linalg.norm(x)


def _frame(
    origin: Float[np.ndarray, "3"], z: Float[np.ndarray, "3"], x: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    frame = np.eye(4)
    frame[:3] = np.stack([x, np.cross(z, x), z, origin], axis=1)
    return frame


def _pose(matrix: Float[np.ndarray, "4 4"]) -> SE3:
    return SE3.from_matrix(jnp.asarray(matrix)).normalize()
