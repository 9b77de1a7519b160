"""Evaluate a fact about edges at points that are known with a covariance."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..modeling import Lines, Shape
from .document import DrawnConstraint
from .known_facts import constraint_of


class FactValue(NamedTuple):
    """The numbers that are zero if a fact is true, m or rad, with their covariance.

    Attributes:
        values: the numbers.
        covariance: due to the points' joint covariance.
        apart: the covariance if the points' coordinates were independent of each other; an exact
            fact that is stated already leaves nothing of it.
    """

    values: Float[np.ndarray, "numbers"]
    covariance: Float[np.ndarray, "numbers numbers"]
    apart: Float[np.ndarray, "numbers numbers"]


def fact_value(
    fact: DrawnConstraint,
    points: Sequence[int],
    positions: Float[np.ndarray, "points 3"],
    covariance: Float[np.ndarray, "coordinates coordinates"],
) -> FactValue:
    """Return the numbers of a fact about edges.

    Args:
        fact: the fact; one with an unknown plane has no numbers of its own.
        points: ids of points, the fact's own among them.
        positions: their positions, m.
        covariance: joint covariance of their coordinates, m^2.
    """
    involved = sorted({point for group in fact.items for point in group})
    place = {point: k for k, point in enumerate(points)}
    rows = [place[point] for point in involved]
    constraint = constraint_of(fact, {point: k for k, point in enumerate(involved)})
    nothing = np.zeros((0, 3))
    shape = Shape(positions[rows], Lines(nothing, nothing), nothing, np.zeros(0), nothing)
    found = constraint.evaluate(shape, -1)
    J = np.concatenate([found.jacobians["point", k] for k in range(len(involved))], axis=1)
    columns = np.concatenate([3 * row + np.arange(3) for row in rows])
    joint = covariance[np.ix_(columns, columns)]
    return FactValue(found.values, J @ joint @ J.T, J * np.diag(joint) @ J.T)
