"""Keep what `propose_model` offers until a person accepts or rejects it, one by one."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..modeling import ModelProposal
from .document import Document

SAME_POINT_DISTANCE = 2.0
"""Distance from a click, px, within which a proposed point is one that is there already."""


class ProposedPoint(NamedTuple):
    """A point that was matched over several views by itself.

    Attributes:
        clicks: the corners that belong together, by view.
        rms: reprojection error, px.
        similarity: mean correlation of its surroundings in the views.
    """

    clicks: dict[str, tuple[float, float]]
    rms: float
    similarity: float


class Proposals:
    """Points and edges that are offered and not decided yet.

    Attributes:
        points: by their number in the proposal.
        edges: pairs of such numbers.
    """

    def __init__(self, found: ModelProposal | None, names: Sequence[str], document: Document):
        """Offer what was found, without points that were clicked already."""
        self.points: dict[int, ProposedPoint] = {}
        self.edges: list[tuple[int, int]] = []
        # The point of the document that an accepted one, or one that was there, has become.
        self._made: dict[int, int] = {}
        if found is None:
            return
        self.edges = [(int(a), int(b)) for a, b in found.edges]
        for k in range(len(found.points)):
            clicks = {
                name: (float(u), float(v))
                for name, (u, v) in zip(names, found.pixels[:, k], strict=True)
                if np.isfinite(u)
            }
            # What was clicked by hand already need not be decided again, but edges may end there.
            known = _known_point(clicks, document)
            if known is None:
                self.points[k] = ProposedPoint(
                    clicks, float(found.rms[k]), float(found.similarity[k])
                )
            else:
                self._made[k] = known

    def accepted(self, numbers: Sequence[int], document: Document) -> dict[str, Any]:
        """Return the change that adds points, and edges whose two points are there then.

        Raises:
            ValueError: a number that is not offered.
        """
        changes: list[dict[str, Any]] = []
        # Ids are given in order, so the ids of what is added are known before it is.
        made, next_id = dict(self._made), document.next_id
        for number in numbers:
            if number not in self.points:
                raise ValueError(f"there is no proposed point {number}")
            clicks = {view: list(pixel) for view, pixel in self.points[number].clicks.items()}
            changes.append({"do": "add_point", "clicks": clicks})
            made[number] = next_id
            next_id += 1
        # A point that was accepted and deleted since is no end of an edge.
        there = set(document.points) | set(range(document.next_id, next_id))
        drawn = {frozenset(ends) for ends in document.edges.values()}
        for a, b in self.edges:
            ends = frozenset(made[end] for end in (a, b) if made.get(end) in there)
            new = {a, b} & set(numbers)
            if len(ends) == 2 and new and ends not in drawn:
                changes.append({"do": "add_edge", "ends": sorted(ends)})
                drawn.add(ends)
        return {"do": "several", "changes": changes}

    def decide(self, numbers: Sequence[int], document_before: Document | None) -> None:
        """Take points from the offer, after they were accepted into a document or rejected.

        Args:
            numbers: of the points.
            document_before: as it was before they were accepted; None if they were rejected.
        """
        for k, number in enumerate(numbers):
            self.points.pop(number, None)
            if document_before is not None:
                self._made[number] = document_before.next_id + k


def _known_point(clicks: dict[str, tuple[float, float]], document: Document) -> int | None:
    """Return the point of a document that was clicked where a proposed one is, or None."""
    for number, made in document.points.items():
        common = set(made) & set(clicks)
        # In every common view: two corners may lie on one ray in one view.
        near = [np.hypot(*np.subtract(made[v], clicks[v])) <= SAME_POINT_DISTANCE for v in common]
        if near and all(near):
            return number
    return None
