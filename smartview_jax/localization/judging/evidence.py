"""Count the evidence of the pictures for and against a pose of a known object."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import binom, gammaln

from ..edges import EXPLAINED_DISTANCE, INDEPENDENT_LENGTH, EdgeLines, Wireframe
from ..rig_noise import ViewDisagreement
from .moved_faces import MovedFace
from .options import DEFAULT_OPTIONS, VerdictOptions

MIN_PARALLAX = float(np.deg2rad(2.0))
"""Smallest angle between the viewing directions of two pictures of an object, rad, from which their
parallax determines its distance, and so its size."""

MIN_VIEW_PX = 60.0
"""Smallest visible edge length, px, for a view to be judged by its own share."""

SMALLEST_DISTANCE = 0.03
"""RMS distance of edges, px, below which they are no less probable in clutter."""

MIN_EXACT_EDGES = 4
"""Smallest number of edges for which the probability of a chance fit is computed."""


class Evidence(NamedTuple):
    """The numbers on which the verdict on a pose rests, without the comparison with rivals.

    Attributes:
        explained: share of the visible edge length with an edge point, all views together.
        explained_in_view: the same for each view; NaN where too little of the object is visible.
        visible_px: visible edge length of all views, px.
        is_alone: whether only one picture shows it, or several from one direction (`MIN_PARALLAX`).
        edges: number of measured edges, counted in each view.
        has_faces: whether the model has edges between two faces, and all of them show; only then
            its size can be tested (`moved`).
        edge_rms: RMS distance of measured edges from the model, px.
        in_picture: share of the vertices within the picture, in the view that shows most of them.
        in_front: share of its edges that no known object hides, all views together.
        log_likelihood: log-likelihood ratio of the found and missing edges, object to clutter.
        log_exactness: see `log_chance_of_exact_edges`.
        moved: see `likeliest_moved_face`; None where it was not computed.
        disagreement: of the views about all objects (`rig_noise`); None where no object shows well
            enough in two views alone.
        shadow_odds: see `log_odds_to_shadow`; None where nothing casts a shadow there.
        tolerance_px: part of `edge_rms` that the model's tolerance explains, px.
    """

    explained: float
    explained_in_view: tuple[float, ...]
    visible_px: float
    is_alone: bool
    edges: int
    has_faces: bool
    edge_rms: float
    in_picture: float
    in_front: float
    log_likelihood: float
    log_exactness: float
    moved: MovedFace | None = None
    disagreement: ViewDisagreement | None = None
    shadow_odds: float | None = None
    tolerance_px: float = 0.0

    @property
    def log_odds(self) -> float:
        """The log-likelihood ratio with the exactness of the fit, by which rivals are compared."""
        return log_odds_of(self.log_likelihood, self.log_exactness)


def evidence_of(
    lines: EdgeLines,
    wireframe: Wireframe,
    is_alone: bool,
    absorbed: float = 0.0,
    options: VerdictOptions = DEFAULT_OPTIONS,
) -> Evidence:
    """Return the evidence of the pictures for and against a pose.

    Args:
        lines: edges measured at the pose, within `EXPLAINED_DISTANCE`.
        wireframe: of the model.
        is_alone: whether only one picture shows it, or several from one direction.
        absorbed: number of edge measurements absorbed by the calibration errors with which the
            views are corrected.
        options: probabilities of edge points.
    """
    visible, explained = lines.visible_px.sum(axis=1), lines.explained_px.sum(axis=1)
    in_view = np.where(visible >= MIN_VIEW_PX, explained / np.maximum(visible, 1.0), np.nan)
    # The two numbers are distances at the mean and at one spread from it: their squares add up.
    distances = np.linalg.norm(lines.offsets[lines.measured], axis=1)
    tolerances = lines.tolerance_px[lines.measured]
    total, share = float(visible.sum()), float(explained.sum() / max(visible.sum(), 1.0))
    return Evidence(
        share,
        tuple(in_view.tolist()),
        total,
        is_alone,
        int(lines.measured.sum()),
        wireframe.smooth is None
        and bool((np.asarray(wireframe.edge_faces).sum(axis=1) >= 2).any()),
        float(np.sqrt((distances**2).mean())) if len(distances) else np.inf,
        float(lines.in_picture.max()),
        total / max(total + float(lines.behind_px.sum()), 1.0),
        log_likelihood_of(share, total, options),
        log_chance_of_exact_edges(distances, absorbed),
        tolerance_px=float(np.sqrt((tolerances**2).mean())) if len(tolerances) else 0.0,
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


def log_likelihood_of(share: float, visible_px: float, options: VerdictOptions) -> float:
    """Return the log-likelihood ratio of found and missing edge length, object to clutter."""
    # Each piece is found with probability q if the object is there, and with p in clutter:
    #   l = n (x log(q / p) + (1 - x) log((1 - q) / (1 - p)))
    p, q = options.chance_probability, options.found_probability
    pieces = visible_px / INDEPENDENT_LENGTH
    return pieces * (share * np.log(q / p) + (1.0 - share) * np.log((1.0 - q) / (1.0 - p)))


def log_likelihood_of_found(found_px: float, options: VerdictOptions) -> float:
    """Return the log-likelihood ratio of found edge length, object to clutter.

    Missing length does not count, because something may hide it.
    """
    odds = options.found_probability / options.chance_probability
    return found_px / INDEPENDENT_LENGTH * float(np.log(odds))


def log_odds_of(log_likelihood: float, log_exactness: float) -> float:
    """Return the log-likelihood ratio to clutter, including how exactly the edges fit.

    Args:
        log_likelihood: natural logarithm of the likelihood ratio of found and missing edges.
        log_exactness: decimal logarithm from `log_chance_of_exact_edges`.
    """
    return log_likelihood - float(np.log(10.0)) * log_exactness


def log_chance_of_exactness(rms: float, edges: int, absorbed: float = 0.0) -> float:
    """Return the decimal logarithm of the probability that clutter edges fit this exactly.

    By chance each edge's two numbers are uniform within `EXPLAINED_DISTANCE`; the six numbers of
    the pose and those that errors of the calibration absorb are subtracted (Moisan and Stival, "A
    probabilistic criterion to detect rigid point matches", 2004).
    """
    # The ball sum x^2 <= n r^2 has the part pi^(n/2) (r sqrt(n))^n / Gamma(n/2 + 1) of the cube
    # (2 d)^n.
    n = 2 * edges - 6 - absorbed
    if n <= 0:
        return 0.0
    radius = max(rms, SMALLEST_DISTANCE) / np.sqrt(2.0) * np.sqrt(n)
    part = 0.5 * n * np.log(np.pi) + n * np.log(radius / (2.0 * EXPLAINED_DISTANCE))
    return min(float((part - gammaln(0.5 * n + 1.0)) / np.log(10.0)), 0.0)


def log_chance_of_exact_edges(
    distances: Float[np.ndarray, "edges"], absorbed: float = 0.0
) -> float:
    """Return the decimal logarithm of the expected number of edge sets that fit so well by chance.

    An edge of another object next to an edge of this one is no evidence against the other edges.
    For each k the k best edges are tested, and the least probable of these sets counts. All sets
    of k out of n edges might have been chosen, which the number of sets corrects for (Moisan and
    Stival).

    Args:
        distances: distances of the measured edges from the model, px.
        absorbed: as in `log_chance_of_exactness`.
    """
    n, squares = len(distances), np.cumsum(np.sort(distances) ** 2)
    sizes = range(MIN_EXACT_EDGES, n + 1)
    logs = [
        np.log10(len(sizes) * binom(n, k))
        + log_chance_of_exactness(float(np.sqrt(squares[k - 1] / k)), k, absorbed)
        for k in sizes
    ]
    return float(min(0.0, *logs)) if logs else 0.0
