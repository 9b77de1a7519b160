"""Compute Denavit-Hartenberg parameters from the joint axes of an arm at its zero position.

Each link's frame lies on the common normal of its axis and the next: z along the axis, x along the
normal, so that the `standard` parameters map one frame exactly to the next. If two axes intersect,
x is perpendicular to both. If they are parallel, the common normal is not unique; the one through
the origin of the last frame is used, so that `d` is zero.

Source: Denavit and Hartenberg, A kinematic notation for lower-pair mechanisms, 1955.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..geometry import as_se3, host_exponentials, host_matrices, host_poses
from .serial_arm import SerialArm

PARALLEL_TOLERANCE = 1e-9
"""Largest sine of the angle between two axes that are treated as parallel (no unit).

The same number, in m, bounds the distance of parallel axes that are treated as coincident.
"""


def arm_from_axes(
    points: Float[np.ndarray, "joints 3"],
    directions: Float[np.ndarray, "joints 3"],
    base_from_tool: Float[np.ndarray, "4 4"],
    prismatic: Sequence[bool] | None = None,
    limits: Float[np.ndarray, "joints 2"] | None = None,
) -> SerialArm:
    """Return the arm whose joints rotate about, or slide along, the given axes.

    Args:
        points: one point on each axis, in the base frame, with all joints at zero, m.
        directions: direction of each axis; the length does not matter.
        base_from_tool: pose of the tool with all joints at zero.
        prismatic: whether each joint is prismatic.
        limits: lower and upper limit of each joint, rad or m.

    Raises:
        ValueError: an axis has no direction; the message counts joints from one.
    """
    lengths = np.linalg.norm(directions, axis=1)
    for k in np.flatnonzero(~(lengths > 0.0)):
        raise ValueError(f"joint {1 + k}: the axis has no direction")
    directions = directions / lengths[:, None]
    first_frame = frame = _frame(points[0], directions[0], _perpendicular(directions[0]))
    rows = []
    # Decompose each step from one axis to the next into the standard parameters,
    #     frame(k+1) = frame(k) Rz(theta) Tz(d) Tx(a) Rx(alpha):
    # theta is the angle from the frame's x to the common normal, d the distance along z to the foot
    # of that normal, a the length of the normal, alpha the angle between the axes about it.
    for k in range(1, len(points)):
        foot, x, length = _common_normal(frame, points[k], directions[k])
        theta = np.arctan2(x @ frame[:3, 1], x @ frame[:3, 0])
        d = (foot - frame[:3, 3]) @ frame[:3, 2]
        sine = np.cross(frame[:3, 2], directions[k]) @ x
        alpha = np.arctan2(sine, frame[:3, 2] @ directions[k])
        rows.append((theta, d, length, alpha))
        frame = _frame(foot + length * x, directions[k], x)
    # The last joint has no next axis. Its row is zero, and the fixed transform to the tool, which
    # follows, holds the rest.
    theta, d, a, alpha = np.array([*rows, (0.0, 0.0, 0.0, 0.0)]).T
    return SerialArm(
        theta,
        d,
        a,
        alpha,
        prismatic=prismatic,
        limits=limits,
        base_from_first=as_se3(first_frame),
        flange_from_tool=as_se3(np.linalg.inv(frame) @ base_from_tool),
    )


def _common_normal(
    frame: Float[np.ndarray, "4 4"], point: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Return the common normal from a frame's z axis to another axis.

    It is described by its foot on the z axis, its direction, and its length, m, which is not
    negative.
    """
    z, displacement = frame[:3, 2], point - frame[:3, 3]
    cross_product = np.cross(z, axis)
    sine = np.linalg.norm(cross_product)
    # Parallel axes: take the normal through the frame's own origin, so that d = 0.
    if sine < PARALLEL_TOLERANCE:
        perpendicular_offset = displacement - (displacement @ z) * z
        length = np.linalg.norm(perpendicular_offset)
        x = perpendicular_offset / length if length > PARALLEL_TOLERANCE else frame[:3, 0]
        return frame[:3, 3], x, float(length)
    # Closest point of two lines o + t z and p + s u, with n = z x u:
    #     t = ((p - o) x u) . n / |n|^2
    x = cross_product / sine
    foot = frame[:3, 3] + (np.cross(displacement, axis) @ cross_product / sine**2) * z
    length = displacement @ x
    # Keep the length positive by reversing x. For intersecting axes the length is a rounding error
    # and both directions of x are correct.
    return (foot, x, float(length)) if length >= 0.0 else (foot, -x, float(-length))


def _perpendicular(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return a unit vector perpendicular to an axis: the base's x if it is perpendicular."""
    reference = np.eye(3)[0 if abs(axis[0]) < 0.9 else 1]
    x = reference - (reference @ axis) * axis
    return x / np.linalg.norm(x)


def _frame(
    origin: Float[np.ndarray, "3"], z: Float[np.ndarray, "3"], x: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Return the homogeneous matrix of a frame with given origin, z axis and x axis."""
    return host_poses(np.stack([x, np.cross(z, x), z], axis=1), origin)


def axis_frames_at_zero(
    arm: SerialArm,
) -> tuple[Float[np.ndarray, "joints 4 4"], Float[np.ndarray, "4 4"]]:
    """Return frames with the joints' axes as z axes, and the flange, where all joints are zero."""
    frame, frames = host_matrices(arm.base_from_first), []
    rows = (np.asarray(row) for row in (arm.theta, arm.d, arm.a, arm.alpha))
    for theta, d, a, alpha in zip(*rows, strict=True):
        # Both parts of a screw are along one axis, so that its exponential is their product.
        turn = host_exponentials(np.array([0.0, 0.0, d, 0.0, 0.0, theta]))
        link = host_exponentials(np.array([a, 0.0, 0.0, alpha, 0.0, 0.0]))
        if arm.convention == "modified":
            frame = frame @ link
        frames.append(frame)
        frame = frame @ turn @ (link if arm.convention == "standard" else np.eye(4))
    return np.stack(frames), frame
