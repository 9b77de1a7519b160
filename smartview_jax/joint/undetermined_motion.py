"""Find the motions of cameras and targets that change no picture, whatever else is estimated.

Each camera is moved on its mount, and each pose of its chain (a target's, an arm's base) in its
frame. A view stays as it is if the mount's motion cancels the effect of the poses' motions; these
are undetermined if one motion of each mount cancels their effect in all views.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..argument_checks import is_selected
from ..dataset import undetermined_motions
from ..engine import ParameterChoice

DETERMINED_PART = 1e-6
"""The smallest component of a unit direction, above rounding, that counts."""

NEGLIGIBLE_PART = float(np.sin(np.deg2rad(10.0)))
"""The component of a direction below which a parameter is not reported as undetermined.

It corresponds to ten degrees, within which an axis is also called by the letter of a coordinate.
"""

_Directions = Float[np.ndarray, "directions parameters"]


class UndeterminedMotion(NamedTuple):
    """The directions of transforms that neither the robot's motion nor given values determine.

    Attributes:
        names: names of the parameters of the transforms.
        directions: change of these parameters along each direction, a unit vector.
        held: the parameters to hold at the start, one for each direction.
    """

    names: tuple[str, ...]
    directions: _Directions
    held: tuple[str, ...]

    @property
    def of_held(self) -> _Directions:
        """The combinations of the directions that each move a single held parameter."""
        columns = [self.names.index(name) for name in self.held]
        directions = np.linalg.solve(self.directions[:, columns], self.directions)
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def pinned_by(self, candidates: Collection[str]) -> tuple[str, ...]:
        """Return which of some parameters to hold so that no direction is left.

        These are all of them if they do not suffice.

        Args:
            candidates: names of the parameters; only parameters of the transforms pin directions.
        """
        columns = [k for k, name in enumerate(self.names) if name in candidates]
        pivots = _pivots(self.directions, columns)
        if len(pivots) < len(self.directions):
            return tuple(candidates)
        return tuple(self.names[k] for k in pivots)

    @property
    def undetermined_names(self) -> tuple[str, ...]:
        """The names of the parameters that are called undetermined."""
        listed = [self.names[k] for direction in self.of_held for k in large_parts(direction)]
        return tuple(dict.fromkeys((*listed, *self.held)))


def large_parts(direction: Float[np.ndarray, "parameters"]) -> list[int]:
    """Return the parameters of a direction that are called undetermined, the largest part first."""
    largest = np.abs(direction).max()
    order = [int(k) for k in np.argsort(-np.abs(direction))]
    return [k for k in order if abs(direction[k]) > NEGLIGIBLE_PART * largest]


class MovablePose(NamedTuple):
    """A transform that a fit estimates, with the names of its six parameters."""

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "4 4"]


class Sight(NamedTuple):
    """The views of one camera, with what the motion of a pose does to its mount.

    Attributes:
        mount: the transform of the camera from its mount.
        motions: for each pose of its chain, by the pose's name, the matrix of each view that maps
            a small motion on the left of this pose to the motion on the right of the mount's
            transform that has the same effect on the picture.
    """

    mount: MovablePose
    motions: Mapping[str, Float[np.ndarray, "views 6 6"]]


def find_undetermined_motion(
    sights: Sequence[Sight],
    poses: Mapping[str, MovablePose],
    choice: ParameterChoice,
    held_first: str = "poses",
) -> UndeterminedMotion:
    """Find the directions that the views, fixed parameters and priors do not determine.

    Args:
        sights: the cameras with their views.
        poses: the poses of their chains, by name.
        choice: the parameters that the user holds, frees or gives priors.
        held_first: whose parameters are held if possible: `"poses"`, or `"mounts"`.
    """
    names = tuple(
        name for pose in (*(s.mount for s in sights), *poses.values()) for name in pose.names
    )
    empty = UndeterminedMotion(names, np.zeros((0, len(names))), ())
    effects = [_effects(sight, list(poses)) for sight in sights]
    directions = _parameter_directions(undetermined_motions(effects), effects, sights, poses)
    known = np.array([is_selected(name, (*choice.fixed, *choice.priors)) for name in names])
    # Combinations of the directions without any change of a known parameter.
    if len(directions) and known.any():
        combinations, part, _ = np.linalg.svd(directions[:, known])
        part = np.append(part, np.zeros(len(directions) - len(part)))
        directions = combinations.T[part <= DETERMINED_PART] @ directions
    if not len(directions):
        return empty
    free, first_pose = np.flatnonzero(~known), 6 * len(sights)
    of_poses, of_mounts = free[free >= first_pose].tolist(), free[free < first_pose].tolist()
    first, others = (of_poses, of_mounts) if held_first == "poses" else (of_mounts, of_poses)
    held = _pivots(directions, first or others) or _pivots(directions, [*first, *others])
    return UndeterminedMotion(names, directions, tuple(names[k] for k in held))


def _effects(sight: Sight, poses: Sequence[str]) -> Float[np.ndarray, "views 6 motions"]:
    """Return the effect on a camera's mount of the motions of all poses, in each view."""
    views = len(next(iter(sight.motions.values())))
    nothing = np.zeros((views, 6, 6))
    return np.concatenate([sight.motions.get(name, nothing) for name in poses], axis=2)


def _parameter_directions(
    motions: Float[np.ndarray, "directions motions"],
    effects: Sequence[Float[np.ndarray, "_ 6 motions"]],
    sights: Sequence[Sight],
    poses: Mapping[str, MovablePose],
) -> _Directions:
    """Return the change of all parameters along each motion of the poses, unit vectors.

    Along a motion the transforms are `camera_from_mount exp(a)` and `exp(b) pose`, where a cancels
    the effect of all b on the mount.
    """
    columns = []
    # A rotation's step multiplies it from the left, a translation's is added: see
    # `engine/parameters.py`.
    for sight, of_views in zip(sights, effects, strict=True):
        turn = sight.mount.matrix[:3, :3]
        of_mount = -motions @ of_views.mean(axis=0).T
        columns += [of_mount[:, :3] @ turn.T, of_mount[:, 3:] @ turn.T]
    for k, pose in enumerate(poses.values()):
        shift, turn = motions[:, 6 * k : 6 * k + 3], motions[:, 6 * k + 3 : 6 * k + 6]
        columns += [shift + np.cross(turn, pose.matrix[:3, 3]), turn]
    directions = np.concatenate(columns, axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _pivots(directions: _Directions, columns: list[int]) -> list[int]:
    """Return one column for each direction that together fix all; empty if there are none."""
    if len(columns) < len(directions):
        return []
    held, remaining = [], directions.copy()
    for _ in directions:
        lengths = np.linalg.norm(remaining[:, columns], axis=0)
        if lengths.max() <= DETERMINED_PART:
            return []
        held.append(columns[int(np.argmax(lengths))])
        # Project out the direction that the new held parameter fixes.
        part = remaining[:, held[-1]] / np.linalg.norm(remaining[:, held[-1]])
        remaining = remaining - np.outer(part, part @ remaining)
    return held
