"""Say where the points of a document are, with what the person knows of them or without."""

import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from ..modeling import ConstraintVerdict, RefinedFeatures
from .document import Document
from .known_facts import constraint_of
from .view_geometry import PointEstimate, ViewGeometry

MAX_JOINT_POINTS = 200
"""Largest number of points under constraints whose covariance a model has with all correlations.

With 200 a file has 360,000 numbers; above, each vertex has its own covariance only.
"""


class _Refinement(NamedTuple):
    """The points of a document with constraints, refined together.

    Attributes:
        made_from: the parts of the document that it depends on.
        estimates: of points by id.
        verdicts: on constraints by id.
        features: the refined points in the document's order.
    """

    made_from: tuple
    estimates: dict[int, PointEstimate]
    verdicts: dict[int, ConstraintVerdict]
    features: RefinedFeatures


class DocumentEstimates:
    """The estimates of documents in fixed views; what was computed last is kept."""

    def __init__(self, geometry: ViewGeometry):
        """Take the views."""
        self._geometry = geometry
        self._last: _Refinement | None = None

    def points(self, document: Document) -> dict[int, PointEstimate]:
        """Return where all points are, by id."""
        # Constraints tie points together; without any, each point is on its own, which is faster.
        if document.constraints:
            return self._refined(document).estimates
        found = self._geometry.estimates(list(document.points.values()))
        return dict(zip(document.points, found, strict=True))

    def verdicts(self, document: Document) -> dict[int, ConstraintVerdict]:
        """Return how each constraint agrees with the pictures and the others, by id."""
        return self._refined(document).verdicts if document.constraints else {}

    def picture_covariance(
        self, document: Document, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"]:
        """Return the covariance of points' coordinates together due to the clicks, m^2.

        The clicks of a point are its own. But constraints let the clicks of one point move others,
        and then their errors are correlated: the length of an edge between two points of a known
        distance has none, though each of them is uncertain.
        """
        if document.constraints:
            place = {point: k for k, point in enumerate(document.points)}
            features = self._refined(document).features
            return features.joint_picture_covariance([place[point] for point in points])
        estimates = self.points(document)
        own = [estimates[point].picture_covariance for point in points]
        return np.asarray(block_diag(*own))

    def correlations(
        self, document: Document, points: Sequence[int]
    ) -> Float[np.ndarray, "coordinates coordinates"] | None:
        """Return the covariance of points together, or None where their own ones say it all."""
        if not document.constraints or len(points) > MAX_JOINT_POINTS:
            return None
        return self.picture_covariance(document, points)

    def distances(
        self, document: Document, pairs: Sequence[tuple[int, int]]
    ) -> list[tuple[float, float]]:
        """Return the distances of pairs of points and their standard deviations, m.

        What the error of the calibration does to both points alike cancels.
        """
        estimates, found = self.points(document), []
        for a, b in pairs:
            one, other = estimates[a], estimates[b]
            difference = other.position - one.position
            length = float(np.linalg.norm(difference))
            # d|b - a| = n . (db - da); two points in one place have no direction, and sigma 0.
            n = difference / max(length, 1e-30)
            gradient = np.concatenate([-n, n])
            # Without constraints the two are independent, which needs no matrix of both.
            if document.constraints:
                variance = gradient @ self.picture_covariance(document, (a, b)) @ gradient
            else:
                variance = n @ (one.picture_covariance + other.picture_covariance) @ n
            common = n @ (other.calibration_factor - one.calibration_factor)
            # An exact constraint leaves rounding error, of either sign.
            found.append((length, float(np.sqrt(max(variance + common @ common, 0.0)))))
        return found

    def _refined(self, document: Document) -> _Refinement:
        """Return points and verdicts of a document with constraints, refined together."""
        made_from = (document.points, document.constraints)
        # The same objects mean the same answer; a document shares what a change left alone.
        last = self._last
        if last is None or not all(map(operator.is_, last.made_from, made_from)):
            number = {point: k for k, point in enumerate(document.points)}
            constraints = [constraint_of(fact, number) for fact in document.constraints.values()]
            points = list(document.points.values())
            found, features = self._geometry.refined(points, constraints)
            named = dict(zip(document.points, found, strict=True))
            judged = dict(zip(document.constraints, features.verdicts, strict=True))
            self._last = last = _Refinement(made_from, named, judged, features)
        return last
