"""List the usual mistakes with poses and pictures, each with a function that corrects it.

A mistake changes `base_from_tool`, or the camera's poses if the pictures are wrong. Angles read in
the wrong format are corrected by converting the rotation back to the numbers of that format and
reading these numbers in the right one. NumPy code, run once on a few dozen matrices.
"""

import itertools
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Poses = Float[np.ndarray, "views 4 4"]
"""Homogeneous matrices, one per view, m."""


class Mistake(NamedTuple):
    """A possible mistake in the data, and the function that corrects it.

    Attributes:
        name: short, for programs.
        words: what was done wrong, as a clause.
        undo: maps robot and camera poses with the mistake to poses without it.
    """

    name: str
    words: str
    undo: Callable[[Poses, Poses], tuple[Poses, Poses]]


def mistakes(in_hand: bool, views: int) -> Iterator[Mistake]:
    """Yield every known mistake, simple ones first.

    Args:
        in_hand: whether the camera is stated to be on the hand.
        views: number of views.
    """
    other = "beside the arm (eye_to_hand)" if in_hand else "on the hand (eye_in_hand)"
    yield Mistake(
        "inverted",
        "every pose is inverted: they were given as tool_from_base where base_from_tool is "
        f"expected, or the camera is {other}",
        lambda robot, camera: (np.linalg.inv(robot), camera),
    )
    yield _of_rotations(
        "transposed", "the rotations are transposed, the positions are not", lambda r: r.inv()
    )
    for read, true, order in (("wxyz", "xyzw", [3, 0, 1, 2]), ("xyzw", "wxyz", [1, 2, 3, 0])):
        yield _of_rotations(
            f"quaternion_{true}",
            f"quaternions in the order {true} were read as {read}",
            lambda r, order=order: Rotation.from_quat(r.as_quat()[:, order]),
        )
    yield Mistake(
        "mirrored",
        "the pictures are mirrored (left and right, or top and bottom, are swapped)",
        lambda robot, camera: (robot, _mirrored(camera)),
    )
    yield from _angles()
    yield from _pairings(views)


def _of_rotations(name: str, words: str, change: Callable[[Rotation], Rotation]) -> Mistake:
    """Return a mistake that concerns the robot's rotations only."""

    def undo(robot: Poses, camera: Poses) -> tuple[Poses, Poses]:
        """Return the poses with corrected robot rotations."""
        changed = robot.copy()
        changed[:, :3, :3] = change(Rotation.from_matrix(robot[:, :3, :3])).as_matrix()
        return changed, camera

    return Mistake(name, words, undo)


def _mirrored(camera: Poses) -> Poses:
    """Return the camera poses of a flat target with every picture mirrored left to right.

    A mirrored view of a plane is a view of it from behind: `F R diag(1, 1, -1)` and `F t`, with F
    the mirror. Top and bottom swapped is the same with the camera rotated by 180 degrees about its
    optical axis, which the hand-eye transform absorbs.
    """
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return mirror @ camera @ np.diag([1.0, 1.0, -1.0, 1.0])


_VAL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""The matrix M0 of VAL's angles, `R = Rz(O) Rx(A) M0 Rz(T)` (Eq. 18).

Since `M0 Rz(T) = Ry(-T) M0`, also `R M0^T = Rz(O) Rx(A) Ry(-T)`: Euler angles with one sign
reversed."""


class _Format(NamedTuple):
    """A format that describes a rotation by three numbers.

    Attributes:
        name: of the pose format.
        words: its name, with the names of equal formats.
        numbers: function from rotations to numbers, `(views, 3)`, rad.
        rotation: its inverse.
        middle: range of the second angle as controllers report it, rad; None for a vector.
    """

    name: str
    words: str
    numbers: Callable[[Rotation], np.ndarray]
    rotation: Callable[[np.ndarray], Rotation]
    middle: tuple[float, float] | None


def _euler(name: str, words: str, axes: str, middle: tuple[float, float]) -> _Format:
    """Return a format of Euler angles about the given axes, in SciPy's notation."""
    return _Format(
        name, words, lambda r: r.as_euler(axes), lambda x: Rotation.from_euler(axes, x), middle
    )


_UPRIGHT = (-0.5 * np.pi, 0.5 * np.pi)
"""Range of the second angle of most formats, rad."""
_SIGN = np.array([1.0, 1.0, -1.0])
"""Signs of O, A, T in the Euler angles of `R M0^T` (see `_VAL`)."""
# KUKA's angles are the yaw, pitch, roll of Eq. 16.
_KUKA = _euler("kuka_abc", "kuka_abc (yaw_pitch_roll)", "ZYX", _UPRIGHT)
_FANUC = _euler("fanuc_wpr", "fanuc_wpr", "xyz", _UPRIGHT)
_FORMATS = (
    _KUKA,
    _FANUC,
    _euler("kawasaki_oat", "kawasaki_oat", "ZYZ", (0.0, np.pi)),
    _Format(
        "val_oat",
        "val_oat",
        lambda r: _SIGN * (r * Rotation.from_matrix(_VAL.T)).as_euler("ZXY"),
        lambda x: Rotation.from_euler("ZXY", _SIGN * x) * Rotation.from_matrix(_VAL),
        _UPRIGHT,
    ),
    _Format("ur", "ur (rotation_vector)", Rotation.as_rotvec, Rotation.from_rotvec, None),
)


def _angles() -> Iterator[Mistake]:
    """Yield the mistakes of angles read in a different format or unit than they were written in."""
    yield _of_rotations(
        "kuka_abc_for_fanuc_wpr",
        "the angles are kuka_abc (yaw_pitch_roll) and were read as fanuc_wpr, or the reverse "
        "(first and third angle swapped)",
        lambda r: _KUKA.rotation(_numbers(r, _FANUC)),
    )
    for read, true in itertools.permutations(_FORMATS, 2):
        if {read, true} == {_KUKA, _FANUC}:
            continue
        # Two triples of numbers describe the rotation that was read, and the true format may
        # produce either of them; try both.
        either = read.middle is None or true.middle == (0.0, np.pi)
        for second in (False, True) if either else (False,):
            yield _of_rotations(
                f"{true.name}_read_as_{read.name}",
                f"the angles are {true.words} and were read as {read.words}",
                lambda r, read=read, true=true, second=second: true.rotation(
                    _as_written(r, read, true, second)
                ),
            )
    for form in _FORMATS:
        # Radians read as degrees: KUKA's and Fanuc's angles are the same three, in reverse order.
        if form is not _FANUC:
            yield _of_rotations(
                f"radians_as_degrees_{form.name}",
                f"the angles ({form.words}) are in radians and were read as degrees",
                lambda r, form=form: form.rotation(np.rad2deg(_numbers(r, form))),
            )


def _numbers(rotation: Rotation, form: _Format) -> np.ndarray:
    """Return the numbers of rotations in a format, without warnings at gimbal lock."""
    with warnings.catch_warnings():
        # At gimbal lock only the sum or difference of two angles is determined; any split is right.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        return form.numbers(rotation)


def _as_written(
    rotation: Rotation, read: _Format, true: _Format, other_first: bool = False
) -> np.ndarray:
    """Return the numbers that were read, in the form that the true format produces.

    Two triples of numbers describe the same rotation in the format `read`; the one within the
    ranges of the format `true` is returned. If both or neither are, the principal one is returned,
    or the other one with `other_first`.
    """
    first = _numbers(rotation, read)
    if read.middle is None:
        length = np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
        # A rotation by |v| about v is also one by |v| - 2 pi.
        second = first * (1.0 - 2.0 * np.pi / length)
    else:
        # Euler angles (a, b, c) describe the same rotation as (a + pi, pi - b, c + pi), and with
        # equal outer axes (ZYZ) the same as (a + pi, -b, c + pi).
        inner = -first[:, 1] if read.middle[0] == 0.0 else np.pi - first[:, 1]
        second = np.stack([first[:, 0] + np.pi, inner, first[:, 2] + np.pi], axis=1)
        second = (second + np.pi) % (2.0 * np.pi) - np.pi
    if other_first:
        first, second = second, first
    return np.where(_written(first, true) | ~_written(second, true), first, second)


def _written(numbers: np.ndarray, true: _Format) -> np.ndarray:
    """Return whether a controller with this format would report these numbers, `(views, 1)`."""
    if true.middle is None:
        return np.linalg.norm(numbers, axis=1, keepdims=True) <= np.pi + 1e-9
    low, high = true.middle
    return ((numbers[:, 1:2] >= low - 1e-9) & (numbers[:, 1:2] <= high + 1e-9)) & (
        np.abs(numbers).max(axis=1, keepdims=True) <= np.pi + 1e-9
    )


def _pairings(views: int) -> Iterator[Mistake]:
    """Yield the mistakes of pictures paired with the poses of other views, in the usual orders."""

    def paired(name: str, words: str, order: np.ndarray) -> Mistake:
        """Return the mistake that a reordering of the robot's poses corrects."""
        return Mistake(
            f"paired_{name}",
            f"the pictures are paired with wrong poses: {words}",
            lambda robot, camera: (robot[order], camera),
        )

    count = np.arange(views)
    for shift in (1, -1, 2, -2):
        where = f"{abs(shift)} view{'s' * (abs(shift) > 1)} {'after' if shift > 0 else 'before'}"
        yield paired(
            f"shifted_{shift}", f"each fits the pose {where} its own", np.roll(count, -shift)
        )
    yield paired("reversed", "they fit the poses in reverse order", count[::-1])
    for first in (0, 1) if views + 1 > 10 else ():
        # File names sorted as text: 1, 10, 11, 2, ... Numbering may start at 0 or 1, and either
        # the pictures or the poses may be the sorted ones.
        by_words = np.array(sorted(count, key=lambda k, first=first: str(k + first)))
        for order in (by_words, np.argsort(by_words)):
            yield paired("sorted", "one of the two is sorted as words (1, 10, 11, 2, ...)", order)
