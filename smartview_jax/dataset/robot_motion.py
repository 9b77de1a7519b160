"""Check whether the robot's poses suffice for a calibration, before anything is fitted to them.

Three questions are answered from the poses and from whether the pictures changed with them:

- Was every pose read again? A row of the pose file that repeats the one before although the picture
  moved was not; such a view is set aside, and so is a view that is given twice. Where the two rows
  are apart, the other views say which of them is wrong.
- Did the robot move at all? Equal poses in all views tell nothing.
- Did it turn? Without a turn the camera's place on the robot cannot be told from the target's:
  both can be shifted together. If all turns have one axis, that is so along the axis.

Shifts of camera and target that cancel in every view correspond to a *twist of the holder* (base or
tool, see `calibration`) that no motion of the robot changes: `Ad(T_i) twist` is the same for every
pose `T_i = mount_from_holder`.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from ..argument_checks import is_selected
from ..fit_result import Rejection
from ..geometry import host_adjoints, host_matrices

if TYPE_CHECKING:
    from .dataset import Dataset
    from .pose_dataset import PoseDataset

Poses = Float[np.ndarray, "views 4 4"]
"""Homogeneous matrices, one per view, m."""

SAME_TRANSLATION, SAME_ROTATION = 2e-5, 5e-5
"""The largest difference between two readings of the same pose, m and rad.

The readings of an arm at rest flicker by the steps of its encoders. For a camera at half a metre
with a focal length of 1000 px this is less than 0.1 px.
"""

MOVED_PICTURE_SHARE = 0.02
"""The shift of a picture, as a share of its longer side, that proves that the robot moved.

An arm that returns to a pose only within 2 mm and 0.4 degrees causes half of this shift.
"""

MIN_TURN = 3e-3
"""The smallest rotation, RMS over the views in rad, that is used: a sixth of a degree.

The effect of a smaller rotation is mostly the robot's error, which more views do not average out. A
robot with an error of 0.1 mm would determine the camera's position to 3 cm; a ruler does better.
"""

MIN_SHIFT = 3e-3
"""The smallest motion besides a turn about one point, RMS in m, from which a size is estimated.

From less a robot with an error of 0.1 mm determines the target's size to 3 %; a ruler does better.
"""

_REPEATED, _DUPLICATE = "its pose repeats view", "its picture and pose are given before, in view"
_DUPLICATE_PAIR = "the robot's and the tracked pose are given before, in view"
"""The beginnings of the three reasons for which a view is left out here."""


def distinct_poses(poses: Poses) -> list[int]:
    """Return the indices of the poses that differ from all before them."""
    return [k for k, first in enumerate(first_equal_pose(poses)) if first == k]


def first_equal_pose(poses: Poses) -> list[int]:
    """Return for each pose the index of the first that is equal to it, which may be its own."""
    first = list(range(len(poses)))
    finite = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    # Only near positions are compared, so that the time does not grow with the square of the views.
    near = KDTree(poses[finite, :3, 3]).query_pairs(2.0 * SAME_TRANSLATION, output_type="ndarray")
    for earlier, later in sorted(map(tuple, np.sort(finite[near], axis=1).tolist())):
        is_first = first[earlier] == earlier and first[later] == later
        if is_first and _is_same_pose(poses[later], poses[earlier]):
            first[later] = earlier
    return first


def _is_same_pose(pose: Float[np.ndarray, "4 4"], other: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether two readings belong to the same pose."""
    # |R - S|_F = sqrt(2) angle for a small angle between them.
    return bool(
        np.abs(pose[:3, 3] - other[:3, 3]).max() <= SAME_TRANSLATION
        and np.linalg.norm(pose[:3, :3] - other[:3, :3]) <= np.sqrt(2.0) * SAME_ROTATION
    )


def repeated_views(data: "Dataset") -> dict[int, str]:
    """Return the views that repeat an earlier view, with the reason to leave each out.

    Views without visible points are not compared.
    """
    reasons = {}
    for pair in _equal_poses(data):
        if pair.is_duplicate:
            reasons[pair.later] = f"{_DUPLICATE} {data.view_ids[pair.earlier]}"
        elif pair.follows and pair.picture_moved(data):
            reasons[pair.later] = _repeated_pose_reason(data, pair.earlier, pair.shift)
    return reasons


def repeated_pairs(data: "PoseDataset") -> dict[int, str]:
    """Return the pairs of poses that repeat an earlier pair, with the reason to leave each out.

    Two measurements of a standing target differ in their last digits; equal ones are one, copied.
    """
    first, tracked = first_equal_pose(host_matrices(data.base_from_tool)), data.tracked_matrices
    known: dict[tuple[int, bytes], int] = {}
    reasons: dict[int, str] = {}
    for view in np.flatnonzero(data.seen).tolist():
        earlier = known.setdefault((first[view], tracked[view].tobytes()), view)
        if earlier != view:
            reasons[view] = f"{_DUPLICATE_PAIR} {data.view_ids[earlier]}"
    return reasons


def contradictory_views(data: "Dataset") -> list[tuple[int, ...]]:
    """Return groups of views with one pose, apart from each other, whose pictures differ.

    At most one view of each group has its own pose: a program that repeats what it read several
    pictures ago, or a row that was copied. Poses alone do not tell which; the other views do.
    """
    groups: dict[int, list[int]] = {}
    for pair in _equal_poses(data):
        if not pair.follows and not pair.is_duplicate and pair.picture_moved(data):
            groups.setdefault(pair.earlier, [pair.earlier]).append(pair.later)
    return [tuple(group) for group in groups.values()]


def repeated_pose_reason(data: "Dataset", view: int, other: int) -> str:
    """Return why a view that has another view's pose is set aside."""
    shift = np.linalg.norm(np.asarray(data.pixels)[view] - np.asarray(data.pixels)[other], axis=-1)
    return _repeated_pose_reason(data, other, float(np.nanmedian(shift)))


def _repeated_pose_reason(data: "Dataset", other: int, shift: float) -> str:
    """Return the same, given the pictures' shift in px."""
    return (
        f"{_REPEATED} {data.view_ids[other]}'s although the picture moved by {shift:.0f} px: it "
        "was not read again"
    )


class _EqualPoses(NamedTuple):
    """Two views with one pose.

    Attributes:
        earlier, later: their indices.
        follows: whether the view before the later one has this pose too.
        is_duplicate: whether the pictures are equal as well.
        shift: median distance between the points of the two pictures, px.
    """

    earlier: int
    later: int
    follows: bool
    is_duplicate: bool
    shift: float

    def picture_moved(self, data: "Dataset") -> bool:
        """Return whether the robot cannot have stood still between the pictures."""
        return self.shift > MOVED_PICTURE_SHARE * max(data.image_size)


def _equal_poses(data: "Dataset") -> Iterator[_EqualPoses]:
    """Yield every view whose pose an earlier one has, where both show points in common."""
    poses, points = host_matrices(data.base_from_tool), np.asarray(data.points)
    pixels, visible = np.asarray(data.pixels), np.asarray(data.visible)
    seen = np.flatnonzero(visible.any(axis=1))
    first = first_equal_pose(poses[seen])
    for place, k in enumerate(seen):
        earlier = int(seen[first[place]])
        if earlier == k:
            continue
        # A target that was raised in front of a camera at rest has other points.
        common = visible[k] & visible[earlier] & (points[k] == points[earlier]).all(axis=-1)
        if not common.any():
            continue
        shifts = np.linalg.norm(pixels[k, common] - pixels[earlier, common], axis=-1)
        yield _EqualPoses(
            earlier,
            int(k),
            first[place - 1] == first[place],
            not shifts.any() and np.array_equal(visible[k], visible[earlier]),
            float(np.median(shifts)),
        )


def stale_poses(data: "Dataset") -> dict[int, str]:
    """Return the views whose pose was not read again, with the reason to leave each out.

    Views whose picture and pose were given twice are not included: a bootstrap repeats views.
    """
    reasons = repeated_views(data).items()
    return {view: text for view, text in reasons if text.startswith(_REPEATED)}


def repetition_warnings(rejected: Sequence[Rejection]) -> list[str]:
    """Return a sentence about poses that were not read again, and one about repeated views."""
    warnings = []
    for beginning, text in (
        (
            _REPEATED,
            "repeat another view's pose although the picture moved, and are left out: the "
            "robot's pose was not read again for them",
        ),
        (_DUPLICATE, "repeat the picture and the pose of an earlier view, and count once"),
        (_DUPLICATE_PAIR, "repeat both poses of an earlier view, and count once"),
    ):
        views = [entry.view for entry in rejected if entry.reason.startswith(beginning)]
        if views:
            names = ", ".join(views[:20]) + (", ..." if len(views) > 20 else "")
            warnings.append(f"{len(views)} views ({names}) {text}")
    return warnings


def require_motion(poses: Poses, mount_name: str, place_is_given: bool) -> None:
    """Raise a ValueError if the robot did not move, or did not rotate and no position is given.

    Args:
        poses: reported poses of the views to use.
        mount_name: name of the hand-eye transform.
        place_is_given: whether the user gives the camera's or the target's position.
    """
    if len(poses) < 2:
        return
    distinct = distinct_poses(poses)
    if len(distinct) == 1:
        raise ValueError(
            f"all {len(poses)} robot poses are equal: the pose was not read again for each "
            "picture, or the robot did not move"
        )
    if len(distinct) < 3:
        raise ValueError(
            f"a calibration needs at least 3 different robot poses; found {len(distinct)} in "
            f"{len(poses)} views"
        )
    if never_turns(poses) and not place_is_given:
        raise ValueError(
            f"the robot never rotates: these poses determine the rotation of {mount_name}, but not "
            "its translation. Rotate the tool about two axes between the pictures; or "
            "give the camera's position: start={'" + mount_name + "': POSE} with "
            f"fixed=('{mount_name}.translation',), or a Prior with a mean for each of "
            f"{mount_name}.translation.x, .y and .z"
        )


def never_turns(poses: Poses) -> bool:
    """Return whether all poses have one orientation."""
    return bool(_turns(poses)[0] < MIN_TURN)


def turns_about_one_axis(poses: Poses) -> bool:
    """Return whether all rotations between the poses share one axis, or there are none."""
    return bool(_turns(poses)[-1] < MIN_TURN)


def turns_about_one_point(poses: Poses) -> bool:
    """Return whether all motions are turns about one point, which tell nothing of lengths.

    Pictures of a target of twice the size, at twice the distance, are then the same.
    """
    # Turns R_i about one point put the tool at a + R_i b, whatever else is unknown.
    rotations = poses[:, :3, :3]
    columns = np.concatenate([np.broadcast_to(np.eye(3), rotations.shape), rotations], axis=2)
    columns, positions = columns.reshape(-1, 6), poses[:, :3, 3].ravel()
    shifts = positions - columns @ np.linalg.lstsq(columns, positions, MIN_TURN)[0]
    return bool(np.linalg.norm(shifts) < MIN_SHIFT * np.sqrt(len(poses)))


def _turns(poses: Poses) -> Float[np.ndarray, "3"]:
    """Return how much the poses rotate directions of the tool, largest first; see `MIN_TURN`."""
    rotations = poses[:, :3, :3]
    # The direction d moves by (R_i - mean R) d.
    rows = (rotations - rotations.mean(axis=0)).reshape(-1, 3)
    return np.linalg.svd(rows, compute_uv=False) / np.sqrt(len(poses))


def undetermined_twists(mount_from_holder: Poses) -> Float[np.ndarray, "twists 6"]:
    """Return orthonormal twists of the holder that all poses map to the same twist of the mount.

    Camera and target can move together along these twists without a change in any picture. There
    are none if the robot rotated about two axes.
    """
    return undetermined_motions([host_adjoints(mount_from_holder)])


def determine_transforms(
    mount_from_holder: Float[np.ndarray, "groups views 4 4"],
) -> Bool[np.ndarray, "groups"]:
    """Return which of several groups of views have no `undetermined_twists`."""
    rows = _differences(host_adjoints(mount_from_holder))
    return np.linalg.svd(rows, compute_uv=False)[:, -1] >= MIN_TURN


def undetermined_motions(
    effects: Sequence[Float[np.ndarray, "_ 6 numbers"]],
) -> Float[np.ndarray, "motions numbers"]:
    """Return orthonormal motions of several poses that move each mount equally in all its views.

    Args:
        effects: for each camera and each view, the matrix that maps the motions of all poses, six
            numbers each, to the twist of the camera's mount that has the same effect.
    """
    rows = [_differences(of_views) for of_views in effects]
    # As many rows as columns, so that what no view mentions has a singular value too.
    rows.append(np.zeros((rows[0].shape[1],) * 2))
    _, changes, motions = np.linalg.svd(np.concatenate(rows), full_matrices=False)
    return motions[changes < MIN_TURN]


def _differences(
    effects: Float[np.ndarray, "*groups views 6 numbers"],
) -> Float[np.ndarray, "*groups rows numbers"]:
    """Return how the effects of motions differ from their mean over the views: RMS in each row."""
    *groups, views, _, numbers = effects.shape
    centred = effects - effects.mean(axis=-3, keepdims=True)
    return centred.reshape(*groups, 6 * views, numbers) / np.sqrt(views)


def given_places(
    transform_names: Sequence[str], fixed: Collection[str], priors: Mapping[str, object]
) -> bool:
    """Return whether the translation of one of the transforms is held or has priors in all axes."""
    paths = (*fixed, *priors)
    return any(
        all(is_selected(f"{name}.translation.{axis}", paths) for axis in "xyz")
        for name in transform_names
    )
