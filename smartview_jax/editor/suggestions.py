"""Suggest facts that the points make likely: equal, parallel and perpendicular edges.

A relation such as "equally long" is weighed against chance: the likelihood of its measured
deviation if it is exactly true, over the likelihood if the two edges have nothing to do with each
other. That ratio is large only where the deviation is small *and* measured so precisely that it
would be a coincidence. Many pairs are compared, so chance is given the odds that the pairs of the
same object suggest: in a box equal edges are common, in a stone they are not.

    posterior odds = share / (1 - share) * p(deviation | true) / p(deviation | unrelated)

with the share of true relations among all pairs of a kind, (1 + sum of their probabilities) over
(2 + pairs), after Laplace's rule of succession.

References:
    Kass and Raftery, Bayes factors, Journal of the American Statistical Association, 1995.
    Efron, Large-scale inference, 2010, chapter 2 (the share from the data themselves).
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.hierarchy import DisjointSet
from scipy.special import chdtrc, expit, logit

from .document import Document, DrawnConstraint
from .document_estimates import DocumentEstimates
from .known_facts import FactValue, fact_value

MIN_ODDS = 20.0
"""Smallest odds of a suggestion: "strong evidence" in the words of Kass and Raftery, 1995."""

DISAGREEMENT_PROBABILITY = 0.01
"""Smallest p-value of the deviation: a fact that would disagree at once is not suggested."""

IMPLIED_VARIANCE = 1e-2
"""Largest part of a deviation's variance that other facts leave where they imply the fact.

They then know it to a tenth of the points' own standard deviation, and the fact adds nothing."""

MAX_EDGES = 40
"""Largest number of edges that are compared with each other, the newest ones: 780 pairs."""

FAR = 8.0
"""Deviation, in standard deviations, beyond which a relation is ruled out."""

EDGE_SIGMAS = 5.0
"""Smallest length of an edge that has a direction, in standard deviations of its length."""

SHARE_STEPS = 100
"""Repetitions of the estimate of the share; it converges in a few tens."""

Ends = tuple[int, int]


class Suggestion(NamedTuple):
    """A fact about two edges that the data make likely, as `ModelSession.add_constraint` takes it.

    Attributes:
        kind: "equal_length", "parallel" or "right_angle".
        items: the ends of the two edges.
        deviation: deviation from the fact, m or rad.
        sigma: standard deviation of the deviation, m or rad.
        odds: odds that the fact is true, to one.
    """

    kind: str
    items: tuple[Ends, Ends]
    deviation: float
    sigma: float
    odds: float


class _Edges(NamedTuple):
    """The lengths and directions of edges, with upper bounds of their standard deviations.

    Attributes:
        lengths: m.
        directions: unit vectors.
        sigmas: largest standard deviation of the difference of the ends in any direction, m.
    """

    lengths: Float[np.ndarray, "edges"]
    directions: Float[np.ndarray, "edges 3"]
    sigmas: Float[np.ndarray, "edges"]

    @classmethod
    def of(
        cls,
        edges: Sequence[Ends],
        points: Sequence[int],
        positions: Float[np.ndarray, "points 3"],
        covariance: Float[np.ndarray, "coordinates coordinates"],
    ) -> "_Edges":
        """Return the edges between points with a joint covariance, m^2."""
        a, b = np.array([[points.index(point) for point in ends] for ends in edges]).T
        blocks = covariance.reshape(len(points), 3, len(points), 3).swapaxes(1, 2)
        variances = blocks[a, a] + blocks[b, b] - blocks[a, b] - blocks[b, a]
        differences = positions[b] - positions[a]
        lengths = np.linalg.norm(differences, axis=1)
        largest = np.linalg.eigvalsh(variances)[:, -1].clip(0.0)
        return cls(lengths, differences / lengths[:, None], np.sqrt(largest))

    def near(self, kinds: Iterable[str]) -> list[Bool[np.ndarray, "edges edges"]]:
        """Return which pairs of edges may have each relation; the others are far from it."""
        cosines = self.directions @ self.directions.T
        turns = self.sigmas / self.lengths
        deviations = {
            "equal_length": (self.lengths[:, None] - self.lengths, self.sigmas),
            "parallel": (np.sqrt((1.0 - cosines**2).clip(0.0)), turns),
            "right_angle": (cosines, turns),
        }
        # The deviation of a pair is at most as uncertain as both edges together.
        return [
            np.abs(deviations[kind][0])
            <= FAR * np.add.outer(deviations[kind][1], deviations[kind][1])
            for kind in kinds
        ]


class _Pair(NamedTuple):
    """Two edges that are compared.

    Attributes:
        items: the ends of both.
        value: the deviation from the fact; None if it is far out of reach.
        evidence: logarithm of the likelihood ratio; infinite if other facts imply it, minus
            infinite if they refute it.
        p_value: probability of so large a deviation if the fact is true.
    """

    items: tuple[Ends, Ends]
    value: FactValue | None
    evidence: float
    p_value: float


def suggestions_of(document: Document, estimates: DocumentEstimates) -> list[Suggestion]:
    """Return the likely facts that are neither stated nor implied, the likeliest first.

    Of facts that follow from each other only the likeliest are returned: three equal edges are two
    facts. Edges of points with contradicting clicks are left out.
    """
    edges = _usable_edges(document, estimates)
    points = sorted({point for ends in edges for point in ends})
    if not points:
        return []
    known = estimates.points(document)
    positions = np.array([known[point].position for point in points])
    covariance = estimates.joint_covariance(document, points)
    measured = _Edges.of(edges, points, positions, covariance)
    # Any difference up to the longest edge is as likely for two edges that are unrelated.
    chance = {**_CHANCE, "equal_length": {1: 1.0 / measured.lengths.max()}}
    compared = {
        kind: [
            _compared(kind, items, points, positions, covariance, densities)
            if near[edges.index(items[0]), edges.index(items[1])]
            else _Pair(items, None, -np.inf, 0.0)
            for items in itertools.combinations(edges, 2)
            # Edges that meet in a point are parallel only if they are one line.
            if kind == "equal_length" or bool(set(items[0]) & set(items[1])) == (kind != "parallel")
        ]
        for (kind, densities), near in zip(chance.items(), measured.near(chance), strict=True)
    }
    likely = {kind: _likely(kind, pairs) for kind, pairs in compared.items()}
    equal = _independent(likely["equal_length"], compared["equal_length"])
    parallel = _independent(likely["parallel"], compared["parallel"])
    # The classes of edges that are parallel, directly or through others.
    directions = DisjointSet(edges)
    for fact in likely["parallel"]:
        directions.merge(*fact.items)
    for pair in compared["parallel"]:
        if pair.evidence == np.inf:
            directions.merge(*pair.items)
    perpendicular = _between_classes(likely["right_angle"], compared["right_angle"], directions)
    return sorted([*equal, *parallel, *perpendicular], key=lambda fact: -fact.odds)


_CHANCE: Mapping[str, Mapping[int, float]] = {
    # The cosine of the angle of two random directions in space is uniform between -1 and 1.
    "right_angle": {1: 0.5},
    # A random direction is uniform on the half sphere; in a plane, on the half circle.
    "parallel": {1: 1.0 / np.pi, 2: 1.0 / (2.0 * np.pi)},
}
"""Probability density of the deviation at zero for unrelated edges, by its number of components."""


def _usable_edges(document: Document, estimates: DocumentEstimates) -> list[Ends]:
    """Return the edges that have a direction and ends without contradicting clicks."""
    known, alone = estimates.points(document), estimates.by_clicks_alone(document)
    edges = [
        ends
        for ends in document.edges.values()
        if not any(known[point].failure or alone[point].wrong_clicks for point in ends)
    ][-MAX_EDGES:]
    lengths = estimates.distances(document, edges)
    return [
        ends
        for ends, (length, sigma) in zip(edges, lengths, strict=True)
        if length > EDGE_SIGMAS * sigma
    ]


def _compared(
    kind: str,
    items: tuple[Ends, Ends],
    points: Sequence[int],
    positions: Float[np.ndarray, "points 3"],
    covariance: Float[np.ndarray, "coordinates coordinates"],
    densities: Mapping[int, float],
) -> _Pair:
    """Return the evidence for a fact about two edges."""
    value = fact_value(DrawnConstraint(kind, items), points, positions, covariance)
    variances, axes = np.linalg.eigh(value.covariance)
    # Components that the stated facts determine say nothing, unless they refute the fact.
    floor = IMPLIED_VARIANCE * np.trace(value.apart)
    used, components = variances > floor, axes.T @ value.values
    if np.any(components[~used] ** 2 > 9.0 * floor):
        return _Pair(items, value, -np.inf, 0.0)
    if not used.any():
        return _Pair(items, value, np.inf, 1.0)
    square = float(np.sum(components[used] ** 2 / variances[used]))
    count = int(used.sum())
    likelihood = -0.5 * square - 0.5 * np.sum(np.log(2.0 * np.pi * variances[used]))
    evidence = float(likelihood - np.log(densities[count]))
    return _Pair(items, value, evidence, float(chdtrc(count, square)))


def _likely(kind: str, pairs: Sequence[_Pair]) -> list[Suggestion]:
    """Return the facts of one kind whose odds are high enough, the likeliest first."""
    evidence = np.array([pair.evidence for pair in pairs])
    share = 0.5
    for _ in range(SHARE_STEPS):
        share = (1.0 + expit(evidence + logit(share)).sum()) / (2.0 + len(pairs))
    facts = []
    for pair in pairs:
        odds = float(np.exp(min(pair.evidence + logit(share), 700.0)))
        # What is implied or refuted is no suggestion.
        if pair.value is None or np.isinf(pair.evidence):
            continue
        if odds >= MIN_ODDS and pair.p_value >= DISAGREEMENT_PROBABILITY:
            deviation = float(np.linalg.norm(pair.value.values))
            # Of several components, along the deviation.
            along = pair.value.values / max(deviation, 1e-30)
            sigma = float(np.sqrt(max(along @ pair.value.covariance @ along, 0.0)))
            facts.append(Suggestion(kind, pair.items, deviation, sigma, odds))
    return sorted(facts, key=lambda fact: -fact.odds)


def _independent(likely: Sequence[Suggestion], pairs: Sequence[_Pair]) -> list[Suggestion]:
    """Return the likeliest facts, without any that follows from likelier or stated ones."""
    classes = DisjointSet(itertools.chain.from_iterable(pair.items for pair in pairs))
    for pair in pairs:
        if pair.evidence == np.inf:
            classes.merge(*pair.items)
    return [fact for fact in likely if classes.merge(*fact.items)]


def _between_classes(
    likely: Sequence[Suggestion], pairs: Sequence[_Pair], directions: DisjointSet
) -> list[Suggestion]:
    """Return the likeliest right angle between each two directions, unless one is stated."""

    def classes_of(items: tuple[Ends, Ends]) -> frozenset[Ends]:
        return frozenset(directions[edge] for edge in items)

    seen = {classes_of(pair.items) for pair in pairs if pair.evidence == np.inf}
    kept = []
    for fact in likely:
        between = classes_of(fact.items)
        if between not in seen:
            kept.append(fact)
            seen.add(between)
    return kept
