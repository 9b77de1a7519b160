"""List the usual mistakes with poses and pictures, each with a function that corrects it.

A mistake changes `base_from_tool`, or the camera's poses if the pictures are wrong. Angles read in
the wrong format are corrected by converting the rotation back to the numbers of that format and
reading these numbers in the right one. NumPy code, run once on a few dozen matrices.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ..geometry import EULER_CONVENTIONS

Poses = Float[np.ndarray, "views 4 4"]
"""Homogeneous matrices, one per view, m."""


class Mistake(NamedTuple):
    """A possible mistake in the data, and the function that corrects it.

    Attributes:
        name: short, for programs.
        description: what was done wrong, as a clause.
        undo: maps the poses as given to robot and camera poses without the mistake.
    """

    name: str
    description: str
    undo: Callable[["GivenPoses"], tuple[Poses, Poses]]


class GivenPoses:
    """The poses as given, and what several mistakes need of the robot's rotations, computed once.

    Attributes:
        robot: the robot's poses.
        camera: the camera's poses.
    """

    def __init__(self, robot: Poses, camera: Poses) -> None:
        self.robot, self.camera = robot, camera
        self._numbers: dict[tuple[str, Any, bool], np.ndarray] = {}
        self._reread: dict[tuple[str, str, bool], np.ndarray] = {}

    @functools.cached_property
    def rotation(self) -> Rotation:
        """The robot's rotations."""
        return Rotation.from_matrix(self.robot[:, :3, :3])

    def with_rotations(self, rotations: np.ndarray) -> tuple[Poses, Poses]:
        """Return the poses with other rotations of the robot."""
        corrected = self.robot.copy()
        corrected[:, :3, :3] = rotations
        return corrected, self.camera

    def reread(
        self, read_format: "_RotationFormat", true_format: "_RotationFormat", alternative: bool
    ) -> np.ndarray:
        """Return the matrices of the numbers that were read, in the true format.

        Args:
            read_format: the format in which the numbers were read.
            true_format: the format in which they were written.
            alternative: which of two triples of numbers (see `_numbers_in_true_range`).
        """
        by_range = read_format.name, true_format.second_angle_range, alternative
        if by_range not in self._numbers:
            self._numbers[by_range] = _numbers_in_true_range(
                self.rotation, read_format, true_format, alternative
            )
        key = read_format.name, true_format.name, alternative
        if key not in self._reread:
            rotation = true_format.to_rotation(self._numbers[by_range])
            self._reread[key] = rotation.as_matrix()
        return self._reread[key]


SQUARE_TOLERANCE = 1e-6
"""Relative difference of a grid's width and height that is a rounding error."""

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
        lambda given: (given.robot, _mirror_camera_poses(given.camera)),
    )
    if turns is not None:
        yield Mistake(
            OTHER_CORNER,
            "in some views the target's points are numbered from another corner",
            lambda given: (given.robot, numbered_alike(given, turns)),
        )
    yield from _angle_format_mistakes()
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
    yield _rotation_mistake(
        "transposed", "the rotations are transposed, the positions are not", lambda r: r.inv()
    )
    for read, true, order in (("wxyz", "xyzw", [3, 0, 1, 2]), ("xyzw", "wxyz", [1, 2, 3, 0])):
        yield _rotation_mistake(
            f"quaternion_{true}",
            f"quaternions in the order {true} were read as {read}",
            lambda r, order=order: Rotation.from_quat(r.as_quat()[:, order]),
        )


def _rotation_mistake(
    name: str, description: str, correction: Callable[[Rotation], Rotation]
) -> Mistake:
    """Return a mistake that concerns the robot's rotations only."""
    return Mistake(
        name,
        description,
        lambda given: given.with_rotations(correction(given.rotation).as_matrix()),
    )


def _mirror_camera_poses(camera: Poses) -> Poses:
    """Return the camera poses of a flat target with every picture mirrored left to right.

    A mirrored view of a plane is a view of it from behind: `F R diag(1, 1, -1)` and `F t`, with F
    the mirror. Top and bottom swapped is the same with the camera rotated by 180 degrees about its
    optical axis, which the hand-eye transform absorbs.
    """
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    return mirror @ camera @ np.diag([1.0, 1.0, -1.0, 1.0])


def numbered_alike(given: GivenPoses, turns: Float[np.ndarray, "turns 4 4"]) -> Poses:
    """Return the camera's poses with the numbering in which it turns as the robot does."""
    candidates = given.camera @ turns[:, None]
    chosen = _turning_alike(candidates[..., :3, :3], given.robot[:, :3, :3])
    # The numbering that most views have stays: the target's frame may be any of them.
    usual = np.bincount(chosen).argmax()
    return candidates[chosen, np.arange(len(chosen))] @ np.linalg.inv(turns[usual])


def target_turns(
    points: Float[np.ndarray, "views points 3"], visible: Bool[np.ndarray, "views points"]
) -> Float[np.ndarray, "turns 4 4"] | None:
    """Return the turns in its plane that take a grid of points into itself, the identity first.

    Half a turn does, and a quarter too where the grid is as wide as high. None without points.

    Args:
        points: points of the target in its frame in each view, m.
        visible: mask of the visible points.
    """
    if not visible.any():
        return None
    low, high = points[visible][:, :2].min(axis=0), points[visible][:, :2].max(axis=0)
    width, height = high - low
    is_square = abs(width - height) < SQUARE_TOLERANCE * max(width, height)
    turns = np.tile(np.eye(4), (4, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(
        np.outer(np.arange(4), [0.0, 0.0, 0.5 * np.pi])
    ).as_matrix()
    centre = 0.5 * (low + high)
    turns[:, :2, 3] = centre - turns[:, :2, :2] @ centre
    return turns if is_square else turns[::2]


def _left_handed_positions() -> Iterator[Mistake]:
    """Yield the mistakes of positions with one axis backwards, whose rotations are right.

    Where the rotations are in the left-handed frame as well, no data tell this from mirrored
    pictures: with S = diag(1, -1, 1, 1) the robot poses S T S need the camera poses F C S of
    `_mirror_camera_poses`, up to rotations that hand-eye and world transform absorb.
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


_VAL_M0 = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""The matrix M0 of VAL's angles, `R = Rz(O) Rx(A) M0 Rz(T)` (Eq. 18).

Since `M0 Rz(T) = Ry(-T) M0`, also `R M0^T = Rz(O) Rx(A) Ry(-T)`: Euler angles with one sign
reversed."""


class _RotationFormat(NamedTuple):
    """A format that describes a rotation by three numbers.

    Attributes:
        name: of the pose format.
        description: its name, with the names of equal formats.
        from_rotation: function from rotations to numbers, `(views, 3)`, rad.
        to_rotation: its inverse.
        second_angle_range: range of the second angle as controllers report it, rad; None for a
            vector.
    """

    name: str
    description: str
    from_rotation: Callable[[Rotation], np.ndarray]
    to_rotation: Callable[[np.ndarray], Rotation]
    second_angle_range: tuple[float, float] | None


def _euler_format(name: str, description: str, convention: str) -> _RotationFormat:
    """Return a format of angles in one of `EULER_CONVENTIONS`."""
    euler = EULER_CONVENTIONS[convention]
    same_outer_axes = euler.axes[0] == euler.axes[2]
    return _RotationFormat(
        name,
        description,
        euler.from_rotation,
        euler.to_rotation,
        (0.0, np.pi) if same_outer_axes else (-0.5 * np.pi, 0.5 * np.pi),
    )


_VAL_ANGLE_SIGNS = np.array([1.0, 1.0, -1.0])
"""Signs of O, A, T in the Euler angles of `R M0^T` (see `_VAL_M0`)."""
_ZXY = EULER_CONVENTIONS["euler_ZXY_moving"]
# KUKA's angles are the yaw, pitch, roll of Eq. 16.
_KUKA = _euler_format("kuka_abc", "kuka_abc (yaw_pitch_roll)", "euler_ZYX_moving")
_FANUC = _euler_format("fanuc_wpr", "fanuc_wpr", "euler_XYZ_fixed")
_FORMATS = (
    _KUKA,
    _FANUC,
    _euler_format("kawasaki_oat", "kawasaki_oat", "euler_ZYZ_moving"),
    _RotationFormat(
        "val_oat",
        "val_oat",
        lambda r: _VAL_ANGLE_SIGNS * _ZXY.from_rotation(r * Rotation.from_matrix(_VAL_M0.T)),
        lambda x: _ZXY.to_rotation(_VAL_ANGLE_SIGNS * x) * Rotation.from_matrix(_VAL_M0),
        (-0.5 * np.pi, 0.5 * np.pi),
    ),
    _RotationFormat("ur", "ur (rotation_vector)", Rotation.as_rotvec, Rotation.from_rotvec, None),
    _euler_format("staubli_val3", "staubli_val3", "euler_XYZ_moving"),
)
"""The formats in which poses are read; other makers have the conventions of one of these."""

_UNUSUAL_FORMATS = tuple(
    _euler_format(name, name, name)
    for name in EULER_CONVENTIONS
    if name not in ("euler_ZYX_moving", "euler_XYZ_fixed", "euler_ZYZ_moving", "euler_XYZ_moving")
)
"""The other conventions of three angles, in which a file may be written without its reader's
knowledge."""


def _misread_pairs() -> Iterator[tuple[_RotationFormat, _RotationFormat]]:
    """Yield pairs of the format that was read and the true one, each effect once."""
    for read_format, true_format in itertools.permutations(_FORMATS, 2):
        if {read_format, true_format} != {_KUKA, _FANUC}:
            yield read_format, true_format
    # Fanuc's angles are KUKA's in reverse order, and so are the conventions with reversed axes that
    # are fixed instead of moving. What was read as Fanuc's is a pair with KUKA's, therefore; two
    # such pairs are among the ones above.
    for read_format, true_format in itertools.product(_FORMATS, _UNUSUAL_FORMATS):
        known = read_format is _KUKA and true_format.name in ("euler_ZYX_fixed", "euler_ZYZ_fixed")
        if read_format is not _FANUC and not known:
            yield read_format, true_format


def _angle_format_mistakes() -> Iterator[Mistake]:
    """Yield the mistakes of angles read in a different format or unit than they were written in."""
    yield _rotation_mistake(
        "kuka_abc_for_fanuc_wpr",
        "the angles are kuka_abc (yaw_pitch_roll) and were read as fanuc_wpr, or the reverse "
        "(first and third angle swapped)",
        lambda r: _KUKA.to_rotation(_FANUC.from_rotation(r)),
    )
    for read_format, true_format in _misread_pairs():
        # Two triples of numbers describe the rotation that was read, and the true format may
        # produce either of them, another one in each view; try both for the first view. With equal
        # outer axes the two differ by the sign of the second angle, which other formats have.
        ambiguous = read_format.second_angle_range is None or (0.0, np.pi) in (
            read_format.second_angle_range,
            true_format.second_angle_range,
        )
        name = f"{true_format.name}_read_as_{read_format.name}"
        description = (
            f"the angles are {true_format.description} and were read as "
            f"{_read_as(read_format, true_format)}"
        )
        # Defaults bind the loop's values now; the functions are called later.
        for prefer_alternative in (False, True) if ambiguous else (False,):
            yield Mistake(
                name,
                description,
                lambda given, read=read_format, true=true_format, alternative=prefer_alternative: (
                    given.with_rotations(given.reread(read, true, alternative))
                ),
            )
        if ambiguous:
            yield Mistake(
                name,
                description,
                lambda given, read=read_format, true=true_format: given.with_rotations(
                    _fitting_rotations(given, read, true)
                ),
            )
    for rotation_format in _FORMATS:
        # Radians read as degrees: KUKA's and Fanuc's angles are the same three, in reverse order.
        if rotation_format is not _FANUC:
            yield _rotation_mistake(
                f"radians_as_degrees_{rotation_format.name}",
                f"the angles ({rotation_format.description}) are in radians and were read as "
                "degrees",
                lambda r, form=rotation_format: form.to_rotation(np.rad2deg(form.from_rotation(r))),
            )


def _read_as(read_format: _RotationFormat, true_format: _RotationFormat) -> str:
    """Return as what angles were read, with the equal mistake of Fanuc's angles."""
    if read_format is not _KUKA or true_format not in _UNUSUAL_FORMATS:
        return read_format.description
    # Reversed axes, fixed instead of moving, are the same angles in reverse order.
    _, axes, kind = true_format.name.split("_")
    reverse = f"euler_{axes[::-1]}_{'fixed' if kind == 'moving' else 'moving'}"
    return f"{read_format.description} (or {reverse} as fanuc_wpr)"


def _numbers_in_true_range(
    rotation: Rotation,
    read_format: _RotationFormat,
    true_format: _RotationFormat,
    prefer_alternative: bool,
) -> np.ndarray:
    """Return the numbers that were read, in the form that the true format produces.

    Two triples of numbers describe the same rotation in the format `read_format`; the one within
    the ranges of the format `true_format` is returned. If both or neither are, the principal one is
    returned, or the other one with `prefer_alternative`.
    """
    principal = read_format.from_rotation(rotation)
    if read_format.second_angle_range is None:
        length = np.maximum(np.linalg.norm(principal, axis=1, keepdims=True), 1e-12)
        # A rotation by |v| about v is also one by |v| - 2 pi.
        alternative = principal * (1.0 - 2.0 * np.pi / length)
    else:
        # Euler angles (a, b, c) describe the same rotation as (a + pi, pi - b, c + pi), and with
        # equal outer axes (ZYZ) the same as (a + pi, -b, c + pi).
        second_angle = (
            -principal[:, 1]
            if read_format.second_angle_range[0] == 0.0
            else np.pi - principal[:, 1]
        )
        alternative = np.stack(
            [principal[:, 0] + np.pi, second_angle, principal[:, 2] + np.pi], axis=1
        )
        alternative = (alternative + np.pi) % (2.0 * np.pi) - np.pi
    if prefer_alternative:
        principal, alternative = alternative, principal
    return np.where(
        _is_in_range(principal, true_format) | ~_is_in_range(alternative, true_format),
        principal,
        alternative,
    )


def _fitting_rotations(
    given: GivenPoses, read_format: _RotationFormat, true_format: _RotationFormat
) -> Float[np.ndarray, "views 3 3"]:
    """Return the rotations by the triples of numbers with which the robot turns as the camera does.

    Of the two rotations that a view may have, the one is chosen whose angles to the other views are
    closer to the camera's.
    """
    candidates = np.stack(
        [given.reread(read_format, true_format, alternative) for alternative in (False, True)]
    )
    return candidates[
        _turning_alike(candidates, given.camera[:, :3, :3]), np.arange(len(given.robot))
    ]


def _turning_alike(
    candidates: Float[np.ndarray, "choices views 3 3"], others: Float[np.ndarray, "views 3 3"]
) -> Int[np.ndarray, "views"]:
    """Return which candidate each view has if the angles between the views are to be the others'.

    Args:
        candidates: rotations of every view, of robot or camera.
        others: rotations of the views, of the other one.
    """
    # The trace of R_i^T R_j is 1 + 2 cos of the angle between two views, of robot and camera.
    expected = np.einsum("imn,jmn->ij", others, others)
    views = np.arange(len(others))
    best, best_misfit = np.zeros(len(others), dtype=int), np.inf
    # The view that is chosen first decides the others; a second pass asks all of them.
    for first in range(len(candidates)):
        between = np.einsum("aimn,mn->ai", candidates, candidates[first, 0])
        chosen = np.abs(between - expected[:, 0]).argmin(axis=0)
        between = np.einsum("aimn,jmn->aij", candidates, candidates[chosen, views])
        chosen = np.abs(between - expected).sum(axis=2).argmin(axis=0)
        rotations = candidates[chosen, views]
        total = np.abs(np.einsum("imn,jmn->ij", rotations, rotations) - expected).sum()
        if total < best_misfit:
            best, best_misfit = chosen, total
    return best


def _is_in_range(numbers: np.ndarray, true_format: _RotationFormat) -> np.ndarray:
    """Return whether a controller with this format would report these numbers, `(views, 1)`."""
    if true_format.second_angle_range is None:
        return np.linalg.norm(numbers, axis=1, keepdims=True) <= np.pi + 1e-9
    low, high = true_format.second_angle_range
    return ((numbers[:, 1:2] >= low - 1e-9) & (numbers[:, 1:2] <= high + 1e-9)) & (
        np.abs(numbers).max(axis=1, keepdims=True) <= np.pi + 1e-9
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
