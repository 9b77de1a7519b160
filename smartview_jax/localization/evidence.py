"""Count what the pictures say for and against a pose of a known object."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .chance import log_chance_of_exact_edges, log_odds_of
from .edge_lines import EdgeLines
from .moved_faces import MovedFace
from .wireframe import Wireframe

MIN_PARALLAX = float(np.deg2rad(2.0))
"""Smallest angle between the directions in which two pictures show an object, rad, from which they
count as two: their parallax tells its distance, and so its size."""

MIN_VIEW_PX = 60.0
"""Visible edge length, px, from which a view is judged by its own share."""

FOUND_PROBABILITY = 0.9
"""Probability that a piece of a truly visible edge has an edge point: shadows and equal brightness
on both sides take the rest."""

MIN_CHANCE, MAX_CHANCE = 0.02, 0.8
"""Smallest and largest share of the visible length that clutter is taken to explain: the few places
at which it is measured cannot tell more."""

TYPICAL_CHANCE = 0.25
"""The share of an edge that clutter is taken to explain where that is not measured: to rank poses
before they are judged, and in views that were not taken."""

INDEPENDENT_LENGTH = 12.0
"""Length of an edge, px, whose being found or not counts as one observation."""


class Evidence(NamedTuple):
    """The numbers of a pose that a verdict rests on, without comparing it with others.

    Attributes:
        explained: share of the visible edge length with an edge point, all views together.
        explained_in_view: likewise in each view; NaN where too little of the object is visible.
        visible_px: visible edge length of all views, px.
        is_alone: whether one picture shows it, or several in one direction, within `MIN_PARALLAX`.
        edges: number of measured edges, each view for itself.
        has_faces: whether some edges of the model are between two faces; the size of anything else
            cannot be asked for (`moved`).
        edge_rms: RMS distance of measured edges from the model, px.
        contrast: see `MIN_CONTRAST`.
        in_picture: part of the vertices within the picture, in the view that has most of them.
        in_front: part of its edges that no known object hides, all views together.
        log_likelihood: of the visible edges being found or not, over their being clutter.
        log_exactness: see `log_chance_of_exact_edges`.
        moved: see `likeliest_moved_face`; None where it was not asked for.
    """

    explained: float
    explained_in_view: tuple[float, ...]
    visible_px: float
    is_alone: bool
    edges: int
    has_faces: bool
    edge_rms: float
    contrast: float
    in_picture: float
    in_front: float
    log_likelihood: float
    log_exactness: float
    moved: MovedFace | None = None

    @property
    def log_odds(self) -> float:
        """The log-likelihood with how exactly the edges fit; rivals are compared by it."""
        return log_odds_of(self.log_likelihood, self.log_exactness)


def evidence_of(
    lines: EdgeLines,
    wireframe: Wireframe,
    strengths: Sequence[Float[np.ndarray, "_"]],
    chance: float,
    is_alone: bool,
    absorbed: float = 0.0,
) -> Evidence:
    """Return what the pictures say for and against a pose.

    Args:
        lines: edges measured at the pose, within `EXPLAINED_DISTANCE`.
        wireframe: of the model.
        strengths: gradients of all edge points of each view, grey levels per px.
        chance: share of visible length that clutter explains.
        is_alone: whether one picture shows it, or several do in one direction.
        absorbed: how many numbers of the edges were explained by errors of the calibration, with
            which the views are corrected.
    """
    visible, explained = lines.visible_px.sum(axis=1), lines.explained_px.sum(axis=1)
    in_view = np.where(visible >= MIN_VIEW_PX, explained / np.maximum(visible, 1.0), np.nan)
    # The two numbers are distances at the mean and at the spread: their squares add up.
    distances = np.linalg.norm(lines.offsets[lines.measured], axis=1)
    total, share = float(visible.sum()), float(explained.sum() / max(visible.sum(), 1.0))
    return Evidence(
        share,
        tuple(in_view.tolist()),
        total,
        is_alone,
        int(lines.measured.sum()),
        bool((np.asarray(wireframe.edge_faces).sum(axis=1) >= 2).any()),
        float(np.sqrt((distances**2).mean())) if len(distances) else np.inf,
        _contrast(lines, strengths),
        float(lines.in_picture.max()),
        total / max(total + float(lines.behind_px.sum()), 1.0),
        log_likelihood_of(share, total, chance),
        log_chance_of_exact_edges(distances, absorbed),
    )


def are_one_direction(
    camera_from_world: Float[np.ndarray, "views 4 4"], place: Float[np.ndarray, "3"]
) -> bool:
    """Return whether all views show a place of the world in one direction, within `MIN_PARALLAX`.

    That is so for a single view.
    """
    in_camera = camera_from_world[:, :3, :3] @ place + camera_from_world[:, :3, 3]
    # The direction from the camera, in the world.
    rays = np.einsum("vij,vi->vj", camera_from_world[:, :3, :3], in_camera)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return bool((rays @ rays.T).min() > np.cos(MIN_PARALLAX))


def log_likelihood_of(share: float, visible_px: float, chance: float) -> float:
    """Return the log-likelihood of found and missing edge length over that of clutter."""
    # Each piece is found with probability q if the object is there, and with p if clutter is:
    #   l = n (x log(q / p) + (1 - x) log((1 - q) / (1 - p)))
    p, q = float(np.clip(chance, MIN_CHANCE, MAX_CHANCE)), FOUND_PROBABILITY
    pieces = visible_px / INDEPENDENT_LENGTH
    return pieces * (share * np.log(q / p) + (1.0 - share) * np.log((1.0 - q) / (1.0 - p)))


def log_likelihood_of_found(found_px: float, chance: float) -> float:
    """Return the log-likelihood of edge length that is found over that of clutter.

    What is missing does not count, because something may hide it.
    """
    return found_px / INDEPENDENT_LENGTH * float(np.log(FOUND_PROBABILITY / chance))


def _contrast(lines: EdgeLines, strengths: Sequence[Float[np.ndarray, "_"]]) -> float:
    """Return the gradient along measured edges, over that of all edge points."""
    if not lines.measured.any():
        return 0.0
    usual = np.array([np.median(one) if len(one) else np.inf for one in strengths])
    ratios = lines.strength / usual[:, None]
    return float(np.median(ratios[lines.measured]))
