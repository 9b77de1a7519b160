"""Say where the points of a document are, with what the person knows of them or without."""

import operator

from ..modeling import ConstraintVerdict
from .document import Document
from .known_facts import constraint_of
from .view_geometry import PointEstimate, ViewGeometry

Estimates = dict[int, PointEstimate]
"""Estimates of points by id."""

Verdicts = dict[int, ConstraintVerdict]
"""Verdicts on constraints by id."""


class DocumentEstimates:
    """The estimates of documents in fixed views; what was computed last is kept."""

    def __init__(self, geometry: ViewGeometry):
        """Take the views."""
        self._geometry = geometry
        self._refinement: tuple[tuple, Estimates, Verdicts] | None = None

    def points(self, document: Document) -> Estimates:
        """Return where all points are, by id."""
        # Constraints tie points together; without any, each point is on its own, which is faster.
        if document.constraints:
            return self._refined(document)[0]
        found = self._geometry.estimates(list(document.points.values()))
        return dict(zip(document.points, found, strict=True))

    def verdicts(self, document: Document) -> Verdicts:
        """Return how each constraint agrees with the pictures and the others, by id."""
        return self._refined(document)[1] if document.constraints else {}

    def _refined(self, document: Document) -> tuple[Estimates, Verdicts]:
        """Return points and verdicts of a document with constraints, refined together."""
        made_from = (document.points, document.constraints)
        # The same objects mean the same answer; a document shares what a change left alone.
        if self._refinement is None or not all(map(operator.is_, self._refinement[0], made_from)):
            number = {point: k for k, point in enumerate(document.points)}
            constraints = [constraint_of(fact, number) for fact in document.constraints.values()]
            points = list(document.points.values())
            found, verdicts = self._geometry.refined(points, constraints)
            named = dict(zip(document.points, found, strict=True))
            judged = dict(zip(document.constraints, verdicts, strict=True))
            self._refinement = (made_from, named, judged)
        return self._refinement[1], self._refinement[2]
