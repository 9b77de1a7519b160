"""Keep the points and edges of `propose_model` until the user accepts or rejects them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..modeling import ModelProposal
from .document import Document

SAME_POINT_DISTANCE = 2.0
"""Distance from a click, px, within which a proposed point is the clicked one."""


class ProposedPoint(NamedTuple):
    """A point that was matched automatically in several views.

    Attributes:
        clicks: the matched corners by view.
        rms: reprojection error, px.
    """

    clicks: dict[str, tuple[float, float]]
    rms: float


class Proposals:
    """Proposed points and edges that are neither accepted nor rejected yet.

    Attributes:
        points: by their number in the proposal.
        edges: pairs of such numbers.
    """

    def __init__(self, proposal: ModelProposal | None, names: Sequence[str], document: Document):
        """Take the points and edges of a proposal, without points that were clicked already."""
        self.points: dict[int, ProposedPoint] = {}
        self.edges: list[tuple[int, int]] = []
        # The document's point for each accepted or already clicked point of the proposal.
        self._made: dict[int, int] = {}
        if proposal is None:
            return
        self.edges = [(int(a), int(b)) for a, b in proposal.edges]
        for k in range(len(proposal.points)):
            clicks = {
                name: (float(u), float(v))
                for name, (u, v) in zip(names, proposal.pixels[:, k], strict=True)
                if np.isfinite(u)
            }
            # A point clicked by hand needs no decision, but edges may end there.
            known = _known_point(clicks, document)
            if known is None:
                self.points[k] = ProposedPoint(clicks, float(proposal.rms[k]))
            else:
                self._made[k] = known

    def accepted(self, numbers: Sequence[int], document: Document) -> dict[str, Any]:
        """Return the change that adds points, and the edges between points that then exist."""
        changes: list[dict[str, Any]] = []
        # Ids are given in order, so the ids of the new points are known in advance.
        made, next_id = dict(self._made), document.next_id
        for number in numbers:
            if number not in self.points:
                raise ValueError(f"no proposed point {number}")
            clicks = {view: list(pixel) for view, pixel in self.points[number].clicks.items()}
            changes.append({"do": "add_point", "clicks": clicks})
            made[number] = next_id
            next_id += 1
        # Accepted points may have been deleted since.
        existing = set(document.points) | set(range(document.next_id, next_id))
        drawn = {frozenset(ends) for ends in document.edges.values()}
        for a, b in self.edges:
            ends = frozenset(made[end] for end in (a, b) if made.get(end) in existing)
            new = {a, b} & set(numbers)
            if len(ends) == 2 and new and ends not in drawn:
                changes.append({"do": "add_edge", "ends": sorted(ends)})
                drawn.add(ends)
        return {"do": "several", "changes": changes}

    def decide(self, numbers: Sequence[int], document_before: Document | None) -> None:
        """Remove accepted points from the offer, given the document before it, or rejected ones."""
        for k, number in enumerate(numbers):
            self.points.pop(number, None)
            if document_before is not None:
                self._made[number] = document_before.next_id + k


def _known_point(clicks: dict[str, tuple[float, float]], document: Document) -> int | None:
    """Return the document's point that was clicked at a proposed point, or None."""
    for number, made in document.points.items():
        common = set(made) & set(clicks)
        # In every common view, because in a single view two corners may coincide.
        near = [np.hypot(*np.subtract(made[v], clicks[v])) <= SAME_POINT_DISTANCE for v in common]
        if near and all(near):
            return number
    return None
