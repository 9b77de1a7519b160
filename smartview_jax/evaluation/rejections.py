"""What a fit left out of the data, and why."""

from collections.abc import Sequence
from typing import Any, NamedTuple


class Rejection(NamedTuple):
    """One point, or one whole view, that a fit did not use.

    Attributes:
        view: its id.
        point: index of the point; None for the whole view.
        reason: why.
    """

    view: str
    point: int | None
    reason: str


class RejectionCount(NamedTuple):
    """How much was left out."""

    points: int
    views: int


def rejected_by(fit: Any) -> tuple[Rejection, ...] | None:
    """What a fit rejected, with what the staged fit before it already had; None if it cannot tell.

    A point that both reject is listed once, with the first reason.
    """
    if not hasattr(fit, "rejected"):
        return None
    before = fit.staged.rejected if hasattr(fit, "staged") else ()
    found: dict[tuple[str, int | None], Rejection] = {}
    for view, point, reason in (*before, *fit.rejected):
        found.setdefault((view, point), Rejection(view, point, reason))
    return tuple(found.values())


def count_rejected(rejected: Sequence[Rejection]) -> RejectionCount:
    """Points rejected one by one, and whole views."""
    views = {item.view for item in rejected if item.point is None}
    points = sum(item.point is not None and item.view not in views for item in rejected)
    return RejectionCount(points, len(views))
