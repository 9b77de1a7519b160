"""Find the most views that agree with each other, however wrong the others are.

A fit to all views bends to those that are far off, so that good views look wrong and wrong ones
hide behind each other. Transforms fitted to three good views fit all other good views as well;
views that agree with these by chance would have to do so in six numbers each.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..dataset import determine_transforms
from ..hand_eye import MAX_PAIRS
from .closure import MAX_CLOSURE_SCORE, Poses
from .transform_fit import closures_of_groups, fit_transforms, misfits

MAX_DISAGREEMENT = 0.5 * MAX_CLOSURE_SCORE
"""Largest disagreement of a view of a group, rotation (rad) plus translation over the distance to
the target: half the limit for the closure of all views."""

MIN_GROUP = 3
"""Fewest views of a group: as many as determine the transforms."""

MAX_TRIPLES = 150
"""Largest number of triples of views that are tried. Where only a third of the views are good, one
triple in 27 is, and so many miss all of them with a probability of 0.003."""

MAX_TOGETHER = 20_000
"""Largest number of closures, or of motions between two views, that are computed at once: ten
megabytes."""

_REFITS = 2
"""Number of fits to the views that agree: three views alone leave the transforms uncertain."""

_Mask = Bool[np.ndarray, "views"]


def disagreements(closure: Poses, distance: float) -> Float[np.ndarray, "*batch views"]:
    """Return the disagreement of each view: rotation plus translation over the distance.

    Args:
        closure: closure error of each view.
        distance: median distance of the target from the camera, m.
    """
    translation, rotation = np.moveaxis(misfits(closure), -1, 0)
    return rotation + translation / distance


def largest_group(
    robot: Poses, camera: Poses, distance: float, tolerance: float = MAX_DISAGREEMENT
) -> Bool[np.ndarray, "views"]:
    """Return the mask of the most views that agree with transforms fitted to them.

    Args:
        robot: `mount_from_holder`, finite.
        camera: `camera_from_world`, finite.
        distance: median distance of the target from the camera, m; infinity for rotations alone.
        tolerance: largest disagreement of a view of the group.
    """
    count = len(robot)
    best = np.zeros(count, dtype=bool)
    if count < MIN_GROUP:
        return best
    triples = _triples(count)
    # Three views that turn about one axis do not tell the transforms, and agree with anything.
    triples = triples[determine_transforms(robot[triples])]
    search = _Search(robot, camera, distance, tolerance)
    agreeing_views = search.agreeing_with(triples)
    refitted, masks = dict[bytes, _Mask](), agreeing_views
    for _ in range(_REFITS):
        masks = search.refit(masks, refitted)
    # Triples of one group soon lead to the same views.
    tried = set[bytes]()
    for agreeing in agreeing_views:
        for _ in range(_REFITS):
            key = agreeing.tobytes()
            if key not in refitted or key in tried:
                break
            tried.add(key)
            agreeing = refitted[key]
        if agreeing.sum() > best.sum():
            best = agreeing
    return best


class _Search(NamedTuple):
    """The views among which the largest group is looked for; the arguments of `largest_group`."""

    robot: Poses
    camera: Poses
    distance: float
    tolerance: float

    def agreeing_with(self, groups: Int[np.ndarray, "groups used"]) -> list[_Mask]:
        """Return the views that agree with transforms fitted to each of several groups of views.

        Args:
            groups: indices of the views of each; their motion determines the transforms.
        """
        size = groups.shape[1]
        at_once = max(MAX_TOGETHER // max(len(self.robot), size * (size - 1) // 2), 1)
        parts = (groups[first : first + at_once] for first in range(0, len(groups), at_once))
        closures = (closures_of_groups(self.robot, self.camera, part) for part in parts)
        return [mask for part in closures for mask in self._agreeing(part)]

    def refit(self, masks: list[_Mask], results: dict[bytes, _Mask]) -> list[_Mask]:
        """Find the views that agree with transforms fitted to the views of each mask.

        Those of equally many views are fitted together, which takes a fraction of the time.

        Args:
            masks: the masks.
            results: the views by the mask's bytes; new ones are added.

        Returns:
            The new results.
        """
        new = {x.tobytes(): np.flatnonzero(x) for x in masks if x.sum() >= MIN_GROUP}
        new = {key: group for key, group in new.items() if key not in results}
        for size in {len(group) for group in new.values()}:
            keys = [key for key, group in new.items() if len(group) == size]
            groups = np.array([new[key] for key in keys])
            # Many views have no common pairs, and some motions leave transforms open.
            together = determine_transforms(self.robot[groups])
            together &= size * (size - 1) // 2 <= MAX_PAIRS
            agreeing = iter(self.agreeing_with(groups[together]))
            for key, group, is_together in zip(keys, groups, together, strict=True):
                results[key] = next(agreeing) if is_together else self._agreeing_with_one(group)
        return [results[key] for key in new]

    def _agreeing_with_one(self, group: Int[np.ndarray, "used"]) -> _Mask:
        """Return the views that agree with transforms fitted to some, whatever their motion."""
        used = np.isin(np.arange(len(self.robot)), group)
        return self._agreeing(fit_transforms(self.robot, self.camera, used).closure)

    def _agreeing(self, closure: Poses) -> Bool[np.ndarray, "*batch views"]:
        """Return whether views agree with transforms that leave over their closure errors."""
        return disagreements(closure, self.distance) < self.tolerance


def _triples(count: int) -> Int[np.ndarray, "triples 3"]:
    """Return all triples of views; of many, some at random."""
    if count * (count - 1) * (count - 2) // 6 <= MAX_TRIPLES:
        return np.array(list(itertools.combinations(range(count), 3)))
    rng = np.random.default_rng(0)
    return np.sort(np.argsort(rng.random((MAX_TRIPLES, count)), axis=1)[:, :3], axis=1)
