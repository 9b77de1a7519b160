"""Estimate the points of a document, with or without constraints."""

import dataclasses
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from ..modeling import ConstraintVerdict, RefinedFeatures, pair_lengths
from .document import Document
from .kept_results import LastResult
from .known_facts import constraint_of
from .view_geometry import PointEstimate, ViewGeometry

MAX_JOINT_POINTS = 200
"""Largest number of points under constraints whose covariance a model has with all correlations.

With 200 a file has 360,000 numbers; above this a file has the covariance of each vertex only.
"""


class _Refinement(NamedTuple):
    """The points of a document with constraints, refined together.

    Estimates and verdicts are by id, features in the document's order; features are None if the
    constraints cannot hold, and the estimates are by the clicks alone.
    """

    estimates: dict[int, PointEstimate]
    verdicts: dict[int, ConstraintVerdict]
    features: RefinedFeatures | None


class DocumentEstimates:
    """The estimates of documents in fixed views; the last result is kept."""

    def __init__(self, geometry: ViewGeometry):
        """Take the views."""
        self._geometry = geometry
        self._last = LastResult[_Refinement]()

    def points(self, document: Document) -> dict[int, PointEstimate]:
        """Return the estimates of all points, by id."""
        # Without constraints each point is triangulated by itself, which is faster.
        if document.constraints:
            return self._refined(document).estimates
        return self.by_clicks_alone(document)

    def by_clicks_alone(self, document: Document) -> dict[int, PointEstimate]:
        """Return the estimates of all points without the constraints, by id."""
        estimates = self._geometry.estimates(list(document.points.values()))
        return dict(zip(document.points, estimates, strict=True))

    def verdicts(self, document: Document) -> dict[int, ConstraintVerdict]:
        """Return whether each constraint agrees with the pictures and the others, by id."""
        return self._refined(document).verdicts if document.constraints else {}

    def picture_covariance(
        self, document: Document, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the joint covariance of points' coordinates due to the clicks, m^2.

        Without constraints points have independent clicks. With constraints the clicks of one point
        move others, so that their errors are correlated: two points at a known distance are
        uncertain, but their distance is not.
        """
        features = self._refined(document).features if document.constraints else None
        if features is not None:
            place = {point: k for k, point in enumerate(document.points)}
            return features.joint_picture_covariance([place[point] for point in points])
        estimates = self.points(document)
        blocks = [estimates[point].picture_covariance for point in points]
        return np.asarray(block_diag(*blocks))

    def correlations(
        self, document: Document, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"] | None:
        """Return the joint covariance of points, or None if they are independent or too many."""
        if not document.constraints or len(points) > MAX_JOINT_POINTS:
            return None
        return self.picture_covariance(document, points)

    def distances(
        self, document: Document, pairs: Sequence[tuple[int, int]]
    ) -> list[tuple[float, float]]:
        """Return the distances of pairs of points and their standard deviations, m.

        The common part of the calibration error cancels.
        """
        estimates, results = self.points(document), []
        for a, b in pairs:
            ends = [estimates[a], estimates[b]]
            positions = np.array([end.position for end in ends])
            (length,), (gradient,) = pair_lengths(positions, [(0, 1)])
            # Without constraints the two are independent.
            from_pictures = (
                self.picture_covariance(document, (a, b))
                if document.constraints
                else np.asarray(block_diag(*(end.picture_covariance for end in ends)))
            )
            common = gradient @ np.concatenate([end.calibration_factor for end in ends])
            variance = gradient @ from_pictures @ gradient + common @ common
            # An exact constraint leaves rounding error, of either sign.
            results.append((float(length), float(np.sqrt(max(variance, 0.0)))))
        return results

    def joint_covariance(
        self, document: Document, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the joint covariance of points' coordinates due to clicks and calibration, m^2."""
        estimates = self.points(document)
        factor = np.concatenate([estimates[point].calibration_factor for point in points])
        return self.picture_covariance(document, points) + factor @ factor.T

    def _refined(self, document: Document) -> _Refinement:
        """Return the joint refinement of a document with constraints."""
        made_from = document.points, document.constraints
        return self._last.of(made_from, lambda: self._with_possible_facts(document))

    def _with_possible_facts(self, document: Document) -> _Refinement:
        """Return the refinement by all constraints but those that cannot hold."""
        whole = self._attempt(document)
        if whole.features is not None:
            return whole
        # Facts that cannot hold are no reason to lose the points, nor facts about other points.
        groups = {document.related_constraints(number) for number in document.constraints}
        parts = [whole] if len(groups) == 1 else [self._attempt(_part(document, g)) for g in groups]
        failed = {k: v for part in parts if part.features is None for k, v in part.verdicts.items()}
        possible = {k: fact for k, fact in document.constraints.items() if k not in failed}
        if not possible:
            return whole._replace(verdicts=failed)
        rest = self._attempt(dataclasses.replace(document, constraints=possible))
        verdicts = failed | rest.verdicts
        return rest._replace(verdicts={k: verdicts[k] for k in document.constraints})

    def _attempt(self, document: Document) -> _Refinement:
        """Return the refinement by all constraints, or the clicks alone if they cannot hold."""
        number = {point: k for k, point in enumerate(document.points)}
        constraints = [constraint_of(fact, number) for fact in document.constraints.values()]
        points = list(document.points.values())
        estimates, features, verdicts = self._geometry.refined(points, constraints)
        judged = dict(zip(document.constraints, verdicts, strict=True))
        if not features.result.converged:
            return _Refinement(self.by_clicks_alone(document), _without_solution(judged), None)
        return _Refinement(dict(zip(document.points, estimates, strict=True)), judged, features)


def _part(document: Document, constraints: Collection[int]) -> Document:
    """Return some of a document's constraints, with their points."""
    facts = {k: document.constraints[k] for k in constraints}
    needed = frozenset[int]().union(*(fact.points for fact in facts.values()))
    points = {k: clicks for k, clicks in document.points.items() if k in needed}
    return Document(points, constraints=facts)


def _without_solution(verdicts: dict[int, ConstraintVerdict]) -> dict[int, ConstraintVerdict]:
    """Return the verdicts on constraints that cannot hold: violated, or nothing known.

    Where no exact one is far from holding, all are violated together.
    """
    wrong = {k for k, verdict in verdicts.items() if verdict.violated} or set(verdicts)
    return {
        k: verdict._replace(violated=k in wrong, contradicts=False)
        for k, verdict in verdicts.items()
    }
