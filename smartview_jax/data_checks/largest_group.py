"""Find the most views that agree with each other, however wrong the others are.

A fit to all views bends to those that are far off, so that good views look wrong and wrong ones
hide behind each other. Transforms fitted to three good views fit all other good views as well;
views that agree with these by chance would have to do so in six numbers each.
"""

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int

from ..dataset import determine_transforms
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

MAX_CLOSURES = 20_000
"""Largest number of closures that are computed at once: ten megabytes."""

_REFITS = 2
"""Number of fits to the views that agree: three views alone leave the transforms uncertain."""


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
    at_once = max(MAX_CLOSURES // count, 1)
    parts = (triples[first : first + at_once] for first in range(0, len(triples), at_once))
    agreeing_views = itertools.chain.from_iterable(
        disagreements(closures_of_groups(robot, camera, part), distance) < tolerance
        for part in parts
    )
    # Triples of one group soon lead to the same views.
    tried = set[bytes]()
    for agreeing in agreeing_views:
        for _ in range(_REFITS):
            if agreeing.sum() < MIN_GROUP or agreeing.tobytes() in tried:
                break
            tried.add(agreeing.tobytes())
            closure = fit_transforms(robot, camera, agreeing).closure
            agreeing = disagreements(closure, distance) < tolerance
        if agreeing.sum() > best.sum():
            best = agreeing
    return best


def _triples(count: int) -> Int[np.ndarray, "triples 3"]:
    """Return all triples of views; of many, some at random."""
    if count * (count - 1) * (count - 2) // 6 <= MAX_TRIPLES:
        return np.array(list(itertools.combinations(range(count), 3)))
    rng = np.random.default_rng(0)
    return np.sort(np.argsort(rng.random((MAX_TRIPLES, count)), axis=1)[:, :3], axis=1)
