"""List the usual mistakes with poses and pictures, each with a function that corrects it.

A mistake changes `base_from_tool`, or the camera's poses if the pictures are wrong. NumPy code, run
once on a few dozen matrices.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .angle_formats import Rotations
from .given_poses import GivenPoses, Mistake, Poses, numbered_alike, rotation_mistake
from .misread_angles import angle_format_mistakes
from .picture_turns import mirrored_poses

OTHER_CORNER = "numbered_from_another_corner"
"""Name of the mistake of points that are numbered from another corner in some views."""


def mistakes(
    in_hand: bool,
    view_count: int,
    turns: Float[np.ndarray, "turns 4 4"] | None = None,
    tracked: bool = False,
) -> Iterator[Mistake]:
    """Yield every known mistake, simple ones first.

    Args:
        in_hand: whether the camera is stated to be on the hand.
        view_count: number of views.
        turns: turns of the target in its plane that take it into itself, the identity first; None
            if they are not known.
        tracked: whether a tracker gave the camera's poses, which may be written wrongly as well.
    """
    other = "next to the arm (eye_to_hand)" if in_hand else "on the hand (eye_in_hand)"
    tracker = ", or the tracked poses as target_from_camera" if tracked else ""
    yield Mistake(
        "inverted",
        "every pose is inverted: they were given as tool_from_base where base_from_tool is "
        f"expected, or the camera is {other}{tracker}",
        lambda given: (np.linalg.inv(given.robot), given.camera),
    )
    yield from _mistakes_of_matrices()
    if tracked:
        yield from map(_of_tracker, _mistakes_of_matrices())
        yield from map(_of_both, _mistakes_of_rotations())
    yield Mistake(
        "mirrored",
        "the tracked poses or the robot's are in a left-handed frame, positions and rotations "
        "alike (one axis counts backwards)"
        if tracked
        else "the pictures are mirrored (left and right, or top and bottom, are swapped), or the "
        "robot's frame is left-handed, positions and rotations alike (one axis counts backwards)",
        lambda given: (given.robot, mirrored_poses(given.camera)),
    )
    if turns is not None:
        yield Mistake(
            OTHER_CORNER,
            "in some views the target's points are numbered from another corner",
            lambda given: (given.robot, numbered_alike(given, turns)),
        )
    yield from angle_format_mistakes()
    yield from _pairing_mistakes(view_count)


def _of_tracker(mistake: Mistake) -> Mistake:
    """Return a mistake in the robot's poses as one in the tracked poses."""

    def undo(given: GivenPoses) -> tuple[Poses, Poses]:
        """Return the poses with the tracked ones corrected."""
        camera, robot = mistake.undo(GivenPoses(given.camera, given.robot))
        return robot, camera

    return Mistake(f"tracker_{mistake.name}", f"in the tracked poses {mistake.description}", undo)


def _of_both(mistake: Mistake) -> Mistake:
    """Return a mistake in the robot's poses as one that a reader made in both files."""

    def undo(given: GivenPoses) -> tuple[Poses, Poses]:
        """Return the poses with the robot's and the tracked ones corrected."""
        robot, _ = mistake.undo(given)
        camera, _ = mistake.undo(GivenPoses(given.camera, given.robot))
        return robot, camera

    return Mistake(
        f"both_{mistake.name}", f"in the robot's and the tracked poses {mistake.description}", undo
    )


def _mistakes_of_matrices() -> Iterator[Mistake]:
    """Yield the mistakes in which poses are written, whoever measured them."""
    yield from _mistakes_of_rotations()
    yield from _left_handed_positions()


def _mistakes_of_rotations() -> Iterator[Mistake]:
    """Yield the mistakes in which rotations are written, whoever measured them."""
    yield rotation_mistake(
        "transposed",
        "the rotations are transposed, the positions are not",
        lambda R: R.swapaxes(1, 2),
    )
    for read, true, order in (("wxyz", "xyzw", [3, 0, 1, 2]), ("xyzw", "wxyz", [1, 2, 3, 0])):
        yield rotation_mistake(
            f"quaternion_{true}",
            f"quaternions in the order {true} were read as {read}",
            lambda R, order=order: _with_quaternions_in_order(R, order),
        )


def _with_quaternions_in_order(rotations: Rotations, order: list[int]) -> Rotations:
    """Return rotations whose quaternions have the entries of the given ones in another order."""
    quaternions = Rotation.from_matrix(rotations).as_quat()
    return Rotation.from_quat(quaternions[:, order]).as_matrix()


def _left_handed_positions() -> Iterator[Mistake]:
    """Yield the mistakes of positions with one axis backwards, whose rotations are right.

    Where the rotations are in the left-handed frame as well, no data tell this from mirrored
    pictures: with S = diag(1, -1, 1, 1) the robot poses S T S need the camera poses F C S of
    `mirrored_poses`, up to rotations that hand-eye and world transform absorb.
    """
    for axis, name in enumerate("xyz"):
        signs = np.ones(3)
        signs[axis] = -1.0

        def undo(given: GivenPoses, signs: np.ndarray = signs) -> tuple[Poses, Poses]:
            """Return the poses with one axis of the positions reversed."""
            corrected = given.robot.copy()
            corrected[:, :3, 3] *= signs
            return corrected, given.camera

        yield Mistake(
            f"left_handed_{name}",
            f"the positions are in a left-handed frame, or {name} has the wrong sign: it counts "
            "backwards, the rotations are right",
            undo,
        )


MAX_PLACES = 40
"""Largest number of places where a picture or a pose may be missing, evenly spaced."""


def _places(view_count: int) -> list[int]:
    """Return the places where a picture or a pose may be missing."""
    return np.unique(np.linspace(2, view_count - 2, MAX_PLACES).astype(int)).tolist()


def _pairing_mistakes(view_count: int) -> Iterator[Mistake]:
    """Yield the mistakes of pictures paired with the poses of other views, in the usual orders."""

    def pairing_mistake(name: str, description: str, order: np.ndarray) -> Mistake:
        """Return the mistake that a reordering of the robot's poses corrects."""
        return Mistake(
            f"paired_{name}",
            f"the pictures are paired with wrong poses: {description}",
            lambda given: (given.robot[order], given.camera),
        )

    indices = np.arange(view_count)
    for shift in (1, -1, 2, -2):
        where = f"{abs(shift)} view{'s' * (abs(shift) > 1)} {'after' if shift > 0 else 'before'}"
        yield pairing_mistake(
            f"shifted_{shift}", f"each fits the pose {where} its own", np.roll(indices, -shift)
        )
    # One picture or one pose is missing: all later ones are off by one.
    for first in _places(view_count):
        for shift in (1, -1):
            order = indices.copy()
            order[first:] = np.roll(indices[first:], -shift)
            where = f"from the view number {first + 1} on, each fits the pose"
            side, missing = ("after", "picture") if shift > 0 else ("before", "pose")
            yield pairing_mistake(
                f"{missing}_missing", f"{where} {side} its own: is a {missing} missing?", order
            )
    yield pairing_mistake("reversed", "they fit the poses in reverse order", indices[::-1])
    for first in (0, 1) if view_count + 1 > 10 else ():
        # File names sorted as text: 1, 10, 11, 2, ... Numbering may start at 0 or 1, and either
        # the pictures or the poses may be the sorted ones.
        sorted_as_text = np.array(sorted(indices, key=lambda k, first=first: str(k + first)))
        for order in (sorted_as_text, np.argsort(sorted_as_text)):
            yield pairing_mistake(
                "sorted", "one of the two is sorted as words (1, 10, 11, 2, ...)", order
            )
