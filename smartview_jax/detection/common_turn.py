"""Which of the turns of a symmetric target all views share: the target's own frame hangs on it.

Robot motion orders the views relative to each other; turned all at once they fit as well as before,
and only the frame of the target is another. So that frame is chosen by where it stands: as a rough
pose says, or else the way round in which it is turned least.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

LEAST_TURN = np.deg2rad(3.0)
"""Turns between views that are smaller have no axis worth the name, rad."""

ONE_AXIS = 0.1
"""Spread of the turns' axes across the main one, as a share, under which they are one axis."""

SAME_SIDE = np.deg2rad(60.0)
"""Angle between the target's z axis and that of a rough pose from which the rough one is wrong."""


class CommonTurn(NamedTuple):
    """The turn that was chosen for all views.

    Attributes:
        symmetry: index of the symmetry to apply to every view.
        words: a sentence that says how many there are, which was taken and why.
    """

    symmetry: int
    words: str


def common_turn(
    camera_rotations: Float[np.ndarray, "views 3 3"],
    mount_rotations: Float[np.ndarray, "views 3 3"],
    points: Float[np.ndarray, "points 3"],
    symmetries: Int[np.ndarray, "symmetries points"],
    holder: str,
    rough: Float[np.ndarray, "3 3"] | None = None,
) -> CommonTurn:
    """Choose the turn under which the target stands as it is roughly said to.

    Args:
        camera_rotations: of `camera_from_world`, in one order over all views.
        mount_rotations: of `mount_from_holder`, from the robot.
        points: of the target, m.
        symmetries: orders that look alike, identity first.
        holder: the frame in which the target stands, `"base"` or `"tool"`, for the words.
        rough: rotation of `holder_from_world`, roughly; None takes the way round in which the
            target's x axis is nearest to the holder's, its z axis being as it is.

    Raises:
        ValueError: the z axis of the rough pose is not that of the target.
    """
    count = len(symmetries)
    alike = f"the target's pattern looks the same in {count} orders of its points"
    advice = (
        "a mark in the pattern would settle it (origin_mark of a circle grid, or a ChArUco board)"
    )
    found = _holder_rotation(camera_rotations, mount_rotations)
    if found is None:
        return CommonTurn(
            0, f"{alike}, and the robot's turns do not tell which was taken: {advice}"
        )
    turned = Rotation.concatenate([found * _turn(points, order) for order in symmetries])
    if rough is None:
        angles = np.abs(_turn_about_z(turned))
        reason = f"where its x axis is nearest to that of the {holder}"
    else:
        given = Rotation.from_matrix(rough)
        _refuse_other_side(turned, given, holder)
        angles = (given.inv() * turned).magnitude()
        reason = f"nearest to the rough {holder}_from_world that was given"
    first, second = np.argsort(angles, kind="stable")[:2]
    taken = (
        f"taken was the one {reason} ({np.rad2deg(angles[first]):.0f} degrees off; the next "
        f"{np.rad2deg(angles[second]):.0f})"
    )
    otherwise = "" if rough is not None else f"; give a rough {holder}_from_world if it is another"
    return CommonTurn(int(first), f"{alike}: {taken}{otherwise}; {advice}")


def _holder_rotation(camera_rotations: np.ndarray, mount_rotations: np.ndarray) -> Rotation | None:
    """Rotation of `holder_from_world` by the first symmetry; None where one axis has all turns."""
    a, b = _turns(camera_rotations), _turns(mount_rotations)
    angle = np.linalg.norm(b, axis=1)
    # Near half a turn an axis may point either way.
    telling = (angle > LEAST_TURN) & (angle < 0.95 * np.pi)
    a, b = a[telling], b[telling]
    if len(b) < 2:
        return None
    spread = np.linalg.svd(b, compute_uv=False)
    if spread[1] < ONE_AXIS * spread[0]:
        return None
    hand_eye = Rotation.align_vectors(a, b)[0]
    for _ in range(3):  # a view in a wrong order must not turn the others
        gap = np.linalg.norm(a - hand_eye.apply(b), axis=1)
        near = gap <= 3.0 * np.median(gap) + 1e-9
        hand_eye = Rotation.align_vectors(a[near], b[near])[0]
    of_views = mount_rotations.swapaxes(1, 2) @ hand_eye.as_matrix().T @ camera_rotations
    cosines = np.einsum("iab,jab->ij", of_views, of_views)
    # The half of the views nearest to all others: those in a wrong order are not among them.
    apart = -np.median(cosines, axis=1)
    return Rotation.from_matrix(of_views[apart <= np.median(apart)]).mean()


def _turns(rotations: np.ndarray) -> np.ndarray:
    """Rotation vectors between all pairs of views, rad."""
    i, j = np.triu_indices(len(rotations), 1)
    return Rotation.from_matrix(rotations[j] @ rotations[i].swapaxes(1, 2)).as_rotvec()


def _turn(points: np.ndarray, order: np.ndarray) -> Rotation:
    """The turn in the target's plane that puts every point where another is in this order."""
    centred = points - points.mean(axis=0)
    return Rotation.align_vectors(centred[order], centred)[0]


def _turn_about_z(rotations: Rotation) -> np.ndarray:
    """Angle about the target's z axis, after the shortest turn that puts z up or down."""
    matrices = rotations.as_matrix()
    # A z axis that points down is that of a board with z into it, seen from above: half a turn
    # about x takes it up, and x stays where it is.
    down = matrices[:, 2, 2] < 0.0
    matrices[down] = matrices[down] @ np.diag([1.0, -1.0, -1.0])
    quaternions = Rotation.from_matrix(matrices).as_quat()
    angle = 2.0 * np.arctan2(quaternions[:, 2], quaternions[:, 3])
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _refuse_other_side(turned: Rotation, given: Rotation, holder: str) -> None:
    """Raise a ValueError where no turn of the pattern has the z axis of the rough pose."""
    z, rough_z = turned.as_matrix()[0, :, 2], given.as_matrix()[:, 2]
    angle = float(np.arccos(np.clip(z @ rough_z, -1.0, 1.0)))
    if angle > SAME_SIDE:
        raise ValueError(
            f"{holder}_from_world: the target's z axis is {np.rad2deg(angle):.0f} degrees from "
            f"where it is said to point, in every order of the pattern; the z axis of this "
            f"target's frame points along ({z[0]:.2f}, {z[1]:.2f}, {z[2]:.2f}) of the {holder} "
            f"frame (into a flat board, out of one that was placed at several heights)"
        )
