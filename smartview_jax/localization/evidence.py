"""Count the evidence of the pictures for and against a pose of a known object."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .chance import log_chance_of_exact_edges, log_odds_of
from .edge_lines import EdgeLines
from .moved_faces import MovedFace
from .view_agreement import ViewDisagreement
from .wireframe import Wireframe

MIN_PARALLAX = float(np.deg2rad(2.0))
"""Smallest angle between the viewing directions of two pictures of an object, rad, from which their
parallax determines its distance, and so its size."""

MIN_VIEW_PX = 60.0
"""Smallest visible edge length, px, for a view to be judged by its own share."""

FOUND_PROBABILITY = 0.9
"""Probability that a piece of a truly visible edge has an edge point; the rest is lost to shadows
and to equal brightness on both sides."""

MIN_CHANCE, MAX_CHANCE = 0.02, 0.8
"""Limits of the share of visible length that clutter explains: it is measured at too few places to
believe a more extreme value."""

TYPICAL_CHANCE = 0.25
"""Share of an edge that clutter explains where this is not measured: to rank poses before they are
judged, and in views that are not taken yet."""

INDEPENDENT_LENGTH = 12.0
"""Length of an edge, px, that counts as one independent observation (found or missing)."""


class Evidence(NamedTuple):
    """The numbers on which the verdict on a pose rests, without the comparison with rivals.

    Attributes:
        explained: share of the visible edge length with an edge point, all views together.
        explained_in_view: the same for each view; NaN where too little of the object is visible.
        visible_px: visible edge length of all views, px.
        is_alone: whether only one picture shows it, or several from one direction (`MIN_PARALLAX`).
        edges: number of measured edges, counted in each view.
        has_faces: whether the model has edges between two faces; only then its size can be tested
            (`moved`).
        edge_rms: RMS distance of measured edges from the model, px.
        contrast: see `MIN_CONTRAST`.
        in_picture: share of the vertices within the picture, in the view that shows most of them.
        in_front: share of its edges that no known object hides, all views together.
        log_likelihood: log-likelihood ratio of the found and missing edges, object to clutter.
        log_exactness: see `log_chance_of_exact_edges`.
        moved: see `likeliest_moved_face`; None where it was not computed.
        disagreement: see `least_agreeing_view`; None where it was not computed, or is unknown.
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
    disagreement: ViewDisagreement | None = None

    @property
    def log_odds(self) -> float:
        """The log-likelihood ratio with the exactness of the fit, by which rivals are compared."""
        return log_odds_of(self.log_likelihood, self.log_exactness)


def evidence_of(
    lines: EdgeLines,
    wireframe: Wireframe,
    strengths: Sequence[Float[np.ndarray, "_"]],
    chance: float,
    is_alone: bool,
    absorbed: float = 0.0,
) -> Evidence:
    """Return the evidence of the pictures for and against a pose.

    Args:
        lines: edges measured at the pose, within `EXPLAINED_DISTANCE`.
        wireframe: of the model.
        strengths: gradients of all edge points of each view, grey levels per px.
        chance: share of visible length that clutter explains.
        is_alone: whether only one picture shows it, or several from one direction.
        absorbed: number of edge measurements absorbed by the calibration errors with which the
            views are corrected.
    """
    visible, explained = lines.visible_px.sum(axis=1), lines.explained_px.sum(axis=1)
    in_view = np.where(visible >= MIN_VIEW_PX, explained / np.maximum(visible, 1.0), np.nan)
    # The two numbers are distances at the mean and at one spread from it: their squares add up.
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
    """Return whether all views show a place of the world from one direction, within `MIN_PARALLAX`.

    It is true for a single view.
    """
    in_camera = camera_from_world[:, :3, :3] @ place + camera_from_world[:, :3, 3]
    # The direction from the camera, in the world.
    rays = np.einsum("vij,vi->vj", camera_from_world[:, :3, :3], in_camera)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return bool((rays @ rays.T).min() > np.cos(MIN_PARALLAX))


def log_likelihood_of(share: float, visible_px: float, chance: float) -> float:
    """Return the log-likelihood ratio of found and missing edge length, object to clutter."""
    # Each piece is found with probability q if the object is there, and with p in clutter:
    #   l = n (x log(q / p) + (1 - x) log((1 - q) / (1 - p)))
    p, q = float(np.clip(chance, MIN_CHANCE, MAX_CHANCE)), FOUND_PROBABILITY
    pieces = visible_px / INDEPENDENT_LENGTH
    return pieces * (share * np.log(q / p) + (1.0 - share) * np.log((1.0 - q) / (1.0 - p)))


def log_likelihood_of_found(found_px: float, chance: float) -> float:
    """Return the log-likelihood ratio of found edge length, object to clutter.

    Missing length does not count, because something may hide it.
    """
    return found_px / INDEPENDENT_LENGTH * float(np.log(FOUND_PROBABILITY / chance))


def _contrast(lines: EdgeLines, strengths: Sequence[Float[np.ndarray, "_"]]) -> float:
    """Return the median gradient along measured edges, over the picture's median edge gradient."""
    if not lines.measured.any():
        return 0.0
    usual = np.array([np.median(view) if len(view) else np.inf for view in strengths])
    ratios = lines.strength / usual[:, None]
    return float(np.median(ratios[lines.measured]))
