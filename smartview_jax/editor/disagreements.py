"""Find the points, edges and facts that disagree with the clicks, and the click that is wrong."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.special import chdtrc

from ..modeling import ConstraintVerdict, pair_lengths
from .document import Document, DrawnConstraint
from .known_facts import constraint_of, fact_value
from .view_geometry import PointEstimate, ViewGeometry

FALSE_ALARM_PROBABILITY = 0.01
"""Probability that any of several equal edges is said to disagree although all are right."""

EXACT_LENGTH_SIGMA = 1e-9
"""Standard deviation of a length that is stated as exact, m: far below any click's."""

MOST_NAMED = 6
"""Largest number of suspects that a sentence names; the list has all of them."""

Click = tuple[int, str]
"""The id of a point and the name of a view in which it was clicked."""


class Disagreement(NamedTuple):
    """A point, an edge or a fact that does not agree with the clicks and the other facts.

    Attributes:
        kind: "points", "edges" or "constraints".
        id: of the point, the edge or the constraint.
        words: what was found, what the others say, and which click is probably wrong.
        suspects: clicks; with any one of them left out, the rest agrees. A single one is most
            probably wrong; with several nobody can tell which; with none no single click explains
            the disagreement.
        residuals: distance from predicted to clicked pixel, px, for the clicks of the point, or of
            all points of the edge or fact.
    """

    kind: str
    id: int
    words: str
    suspects: tuple[Click, ...]
    residuals: Mapping[Click, float]

    def __str__(self) -> str:
        return f"{self.kind.removesuffix('s')} {self.id}: {self.words}"


class Findings(NamedTuple):
    """The estimates of a document, with and without its constraints.

    Attributes:
        estimates: estimates of its points under all facts, by id.
        alone: estimates of its points by their clicks alone, by id.
        verdicts: verdicts on its constraints, by id.
    """

    document: Document
    estimates: Mapping[int, PointEstimate]
    alone: Mapping[int, PointEstimate]
    verdicts: Mapping[int, ConstraintVerdict]

    def contradiction(self, number: int) -> str:
        """Return why a constraint contradicts the clicks or the others; empty if it does not."""
        fact, verdict = self.document.constraints[number], self.verdicts[number]
        if verdict.violated:
            is_lone = len(self.document.related_constraints(number)) == 1
            measured = self._measured(fact) if is_lone else ""
            return measured or "cannot hold together with the other facts and the clicks"
        if not verdict.contradicts:
            return ""
        doubt = f"chi-square {verdict.cost:.1f} of {verdict.degrees_of_freedom}"
        return f"{self._measured(fact) or 'the clicks contradict it'} ({doubt})"

    def _measured(self, fact: DrawnConstraint) -> str:
        """Return what the clicks alone say about a fact; empty if they say nothing simple."""
        points = sorted(fact.points)
        ends = [self.alone[point] for point in points]
        if any(end.failure for end in ends):
            return ""
        if fact.kind == "known_length" and fact.value is not None:
            (length,), ((variance,),) = self.lengths(fact.items)
            return (
                f"{_in_mm(float(length), float(variance))} by the clicks alone, "
                f"{1e3 * fact.value:.2f} mm is stated"
            )
        if fact.kind not in ("equal_length", "right_angle", "parallel"):
            return ""
        value = fact_value(fact, points, *self._alone(points))
        if fact.kind == "equal_length":
            first, second = 1e3 * self.lengths(fact.items)[0]
            difference = _in_mm(float(abs(value.values[0])), float(value.covariance[0, 0]))
            return f"{first:.2f} and {second:.2f} mm by the clicks alone, {difference} apart"
        # The cosine of the angle, or the two components of its sine.
        size = float(np.linalg.norm(value.values))
        along = value.values / max(size, 1e-30)
        sigma = np.sqrt(along @ value.covariance @ along) / np.sqrt(max(1.0 - size**2, 1e-30))
        angle = np.arccos(value.values[0]) if fact.kind == "right_angle" else np.arcsin(size)
        return f"{np.rad2deg(angle):.2f} ± {np.rad2deg(sigma):.2f} degrees by the clicks alone"

    def lengths(
        self, pairs: Sequence[tuple[int, ...]]
    ) -> tuple[Float[np.ndarray, "pairs"], Float[np.ndarray, "pairs pairs"]]:
        """Return the distances of pairs of points by their clicks alone, and their covariance."""
        points = sorted({point for pair in pairs for point in pair})
        positions, covariance = self._alone(points)
        indices = [[points.index(point) for point in pair] for pair in pairs]
        lengths, gradient = pair_lengths(positions, indices)
        return lengths, gradient @ covariance @ gradient.T

    def _alone(
        self, points: Sequence[int]
    ) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, "coordinates coordinates"]]:
        """Return points by their clicks alone, m, and the joint covariance of the coordinates.

        The clicks are as accurate as stated; the errors of the calibration are common to all.
        """
        estimates = [self.alone[point] for point in points]
        factor = np.concatenate([point.calibration_factor for point in estimates])
        pictures = np.asarray(
            block_diag(*(point.nominal_picture_covariance for point in estimates))
        )
        return np.array([point.position for point in estimates]), pictures + factor @ factor.T

    def residuals(self, points: Sequence[int]) -> dict[Click, float]:
        """Return the residuals of all clicks of some points, px."""
        return {
            (point, view): float(np.hypot(*residual))
            for point in points
            for view, residual in self.estimates[point].residuals.items()
        }

    def suspects(self, facts: Iterable[int], geometry: ViewGeometry) -> tuple[Click, ...]:
        """Return the clicks that explain why related facts contradict them, the likeliest first."""
        chosen = sorted(facts)
        constraints = [self.document.constraints[k] for k in chosen]
        points = sorted(frozenset[int]().union(*(fact.points for fact in constraints)))
        estimates = [self.estimates[point] for point in points]
        # Facts that contradict each other say nothing about clicks.
        if any(self.verdicts[k].violated for k in chosen) or any(e.failure for e in estimates):
            return ()
        number = {point: k for k, point in enumerate(points)}
        clicks = geometry.suspects(
            [self.document.points[point] for point in points],
            np.array([estimate.position for estimate in estimates]),
            [constraint_of(fact, number) for fact in constraints],
        )
        return tuple((points[k], view) for k, view in clicks)


def disagreements_of(findings: Findings, geometry: ViewGeometry) -> list[Disagreement]:
    """Return the points, then the edges, then the facts of a document that disagree."""
    wrong_points = [
        _wrong_point(point, estimate, findings)
        for point, estimate in findings.alone.items()
        if estimate.wrong_clicks
    ]
    reasons = {k: findings.contradiction(k) for k in findings.verdicts}
    doubted = {k: reason for k, reason in reasons.items() if reason}
    facts = []
    suspected: dict[frozenset[int], tuple[Click, ...]] = {}
    wrong_edges: dict[int, Disagreement] = {}
    drawn = {frozenset(ends): edge for edge, ends in findings.document.edges.items()}
    for number, reason in doubted.items():
        fact = findings.document.constraints[number]
        related = findings.document.related_constraints(number)
        if related not in suspected:
            suspected[related] = findings.suspects(related, geometry)
        suspects = suspected[related]
        blame = _blame(suspects)
        residuals = findings.residuals(sorted(fact.points))
        facts.append(Disagreement("constraints", number, f"{reason}; {blame}", suspects, residuals))
        for pair, words in _wrong_pairs(fact, reason, findings).items():
            edge = drawn.get(frozenset(pair))
            if edge is not None:
                shown = findings.residuals(sorted(pair))
                wrong_edges.setdefault(
                    edge, Disagreement("edges", edge, f"{words}; {blame}", suspects, shown)
                )
    return [*wrong_points, *wrong_edges.values(), *facts]


def _wrong_point(point: int, estimate: PointEstimate, findings: Findings) -> Disagreement:
    """Return the disagreement of a point with wrong clicks."""
    clicks = estimate.wrong_clicks
    suspects = {view: None for name, click in clicks.items() for view in (name, *click.instead)}
    if len(clicks) == 1 and len(suspects) > 1 and len(findings.document.points[point]) > 2:
        words = (
            f"the click in {_either(list(suspects))} is wrong; the rest agrees if any one of them "
            "is left out, so nobody can tell which: click the point in another view"
        )
    elif len(suspects) > 1 and len(findings.document.points[point]) == 2:
        words = (
            f"the clicks in {' and '.join(suspects)} contradict each other; with two clicks nobody "
            "can tell which is wrong: click the point in a third view"
        )
    else:
        words = "; ".join(
            f"the click in {name} is most probably wrong, {click}" for name, click in clicks.items()
        )
    clicks_to_doubt = tuple((point, view) for view in suspects)
    return Disagreement("points", point, words, clicks_to_doubt, findings.residuals([point]))


def _blame(suspects: Sequence[Click]) -> str:
    """Return which click is wrong, in words."""
    if not suspects:
        return "no single wrong click explains it: is the fact true?"
    if len(suspects) == 1:
        ((point, view),) = suspects
        return (
            f"the click of point {point} in {view} is most probably wrong, the rest agrees "
            "without it"
        )
    named = f"one of {len(suspects)} clicks"
    if len(suspects) <= MOST_NAMED:
        named = f"the click of point {_either([f'{point} in {view}' for point, view in suspects])}"
    return (
        f"the fact is wrong, or {named}; the rest agrees if any one of them is left out, so nobody "
        "can tell which"
    )


def _either(names: Sequence[str]) -> str:
    """Return names as an enumeration."""
    return f"{', '.join(names[:-1])} or {names[-1]}"


def _wrong_pairs(
    fact: DrawnConstraint, reason: str, findings: Findings
) -> dict[tuple[int, ...], str]:
    """Return the edges that are doubted because of a contradicted fact, with the reasons."""
    if fact.kind in ("right_angle", "parallel"):
        return dict.fromkeys(fact.items, reason)
    if fact.kind not in ("known_length", "equal_length"):
        return {}
    return _wrong_lengths(fact, findings) or dict.fromkeys(fact.items, reason)


def _wrong_lengths(fact: DrawnConstraint, findings: Findings) -> dict[tuple[int, ...], str]:
    """Return which of the edges that a fact makes equally long has another length.

    Each edge's length by the clicks alone is compared with the mean of the others and of the
    stated lengths, weighted by their joint covariance.
    """
    pairs, stated = _equal_edges(fact, findings.document.constraints.values())
    if any(findings.alone[point].failure for pair in pairs for point in pair):
        return {}
    measured, covariance = findings.lengths(pairs)
    lengths = np.array([*measured, *(value for value, _ in stated)])
    joint = np.asarray(block_diag(covariance, np.diag([sigma**2 for _, sigma in stated])))
    wrong: dict[tuple[int, ...], str] = {}
    explained: dict[tuple[int, ...], str] = {}
    for k, pair in enumerate(pairs):
        others = np.flatnonzero(np.arange(len(lengths)) != k)
        inverse = np.linalg.inv(joint[np.ix_(others, others)])
        weights = inverse.sum(axis=0) / inverse.sum()
        mean, variance = float(weights @ lengths[others]), 1.0 / float(inverse.sum())
        # The deviation from the weighted mean, as a combination of all lengths.
        combination = np.zeros(len(lengths))
        combination[k], combination[others] = 1.0, -weights
        square = (lengths[k] - mean) ** 2 / (combination @ joint @ combination)
        if chdtrc(1, square) >= FALSE_ALARM_PROBABILITY / len(pairs):
            continue
        measured_words = _in_mm(float(lengths[k]), float(joint[k, k]))
        words = f"{measured_words} by its own clicks, where the others say {_in_mm(mean, variance)}"
        if len(pairs) == 1:
            words = f"{measured_words} by its own clicks, where {1e3 * mean:.2f} mm is stated"
        wrong[pair] = words
        rest, freedom = lengths[others] - mean, len(others) - 1
        if not freedom or chdtrc(freedom, rest @ inverse @ rest) >= FALSE_ALARM_PROBABILITY:
            explained[pair] = words
    # If no single edge explains it, every one that deviates is doubted.
    return explained or wrong


def _equal_edges(
    fact: DrawnConstraint, facts: Collection[DrawnConstraint]
) -> tuple[list[tuple[int, ...]], list[tuple[float, float]]]:
    """Return the edges that facts make as long as one fact's edges, and the stated lengths."""
    equal = [
        {frozenset(pair) for pair in other.items} for other in facts if other.kind == "equal_length"
    ]
    group = {frozenset(pair) for pair in fact.items}
    while more := [pairs for pairs in equal if pairs & group and not pairs <= group]:
        group = group.union(*more)
    stated = [
        (other.value, other.sigma or EXACT_LENGTH_SIGMA)
        for other in facts
        if other.kind == "known_length" and other.value is not None
        if frozenset(other.items[0]) in group
    ]
    return sorted(tuple(sorted(pair)) for pair in group), stated


def _in_mm(length: float, variance: float) -> str:
    """Return a length, m, with its variance, m^2, in words."""
    return f"{1e3 * length:.2f} ± {1e3 * np.sqrt(variance):.2f} mm"
