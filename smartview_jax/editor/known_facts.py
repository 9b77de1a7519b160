"""Convert the user's facts about points and edges to constraints, and evaluate them."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..modeling import (
    AbstractConstraint,
    EqualLength,
    KnownLength,
    Lines,
    OnPlane,
    Parallel,
    RightAngle,
    SamePlane,
    Shape,
    Symmetric,
)
from .document import DrawnConstraint

Groups = Sequence[tuple[int, ...]]
"""Groups of point numbers: pairs for edges, one group for points."""


class FactKind(NamedTuple):
    """A kind of fact that the user can state.

    Attributes:
        words: its name on the page.
        takes: the parts that it constrains: "points" or "edges".
        least: smallest number of these.
        most: largest number of these.
        build: function from groups of vertex numbers, a length (m) and a sigma to the constraint.
    """

    words: str
    takes: str
    least: int
    most: int
    build: Callable[[Groups, float | None, float | None], AbstractConstraint]


def _pair(group: tuple[int, ...]) -> tuple[int, int]:
    """Return the two ends of an edge."""
    a, b = group
    return a, b


def _length(groups: Groups, value: float | None, sigma: float | None) -> AbstractConstraint:
    if value is None:
        raise ValueError("known length: the length is missing")
    return KnownLength(_pair(groups[0]), value, sigma=sigma)


FACT_KINDS: Mapping[str, FactKind] = {
    "same_plane": FactKind(
        "in one plane", "points", 4, 1000, lambda g, _, s: SamePlane(tuple(g[0]), sigma=s)
    ),
    "on_table": FactKind(
        "on the table, z = 0", "points", 1, 1000, lambda g, _, s: OnPlane(tuple(g[0]), sigma=s)
    ),
    "symmetric": FactKind(
        "mirrored in pairs",
        "points",
        2,
        1000,
        # Points were chosen in pairs: a point and its mirror image, and so on.
        lambda g, _, s: Symmetric(tuple(zip(g[0][::2], g[0][1::2], strict=True)), sigma=s),
    ),
    "parallel": FactKind(
        "parallel", "edges", 2, 2, lambda g, _, s: Parallel(_pair(g[0]), _pair(g[1]), sigma=s)
    ),
    "right_angle": FactKind(
        "at right angles",
        "edges",
        2,
        2,
        lambda g, _, s: RightAngle(_pair(g[0]), _pair(g[1]), sigma=s),
    ),
    "equal_length": FactKind(
        "equally long",
        "edges",
        2,
        2,
        lambda g, _, s: EqualLength(_pair(g[0]), _pair(g[1]), sigma=s),
    ),
    "known_length": FactKind("length", "edges", 1, 1, _length),
}
"""Facts by name; an edge is a pair of points."""


def constraint_of(fact: DrawnConstraint, number: Mapping[int, int]) -> AbstractConstraint:
    """Return the constraint of a fact, given the number of each point's vertex by id."""
    kind = FACT_KINDS.get(fact.kind)
    if kind is None:
        raise ValueError(f"expected one of the facts {', '.join(FACT_KINDS)}; found {fact.kind!r}")
    groups = [tuple(number[point] for point in group) for group in fact.items]
    if kind.takes == "points":
        count = len(groups[0]) if len(groups) == 1 else 0
    else:
        count = len(groups) if all(len(group) == 2 for group in groups) else 0
    if not kind.least <= count <= kind.most:
        raise ValueError(
            f"{kind.words}: expected {kind.least} or more {kind.takes}, found {fact.items}"
        )
    return kind.build(groups, fact.value, fact.sigma)


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
    evaluation = constraint.evaluate(shape, -1)
    J = np.concatenate([evaluation.jacobians["point", k] for k in range(len(involved))], axis=1)
    columns = np.concatenate([3 * row + np.arange(3) for row in rows])
    joint = covariance[np.ix_(columns, columns)]
    return FactValue(evaluation.values, J @ joint @ J.T, J * np.diag(joint) @ J.T)
