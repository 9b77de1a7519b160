"""Judge whether an object is where a pose says: accepted, rejected or open, with the numbers.

The test has five parts, each with a threshold that is a constant below and a number in `Verdict`:

- the explained share: of the visible edge length, the part that has an edge point within
  `EXPLAINED_DISTANCE`, of the edge's orientation; in all views together and in each;
- chance: the share that the same wireframe explains at other places of the same pictures, after the
  same convergence. A beta distribution of these shares gives the expected number of poses so well
  explained by what else is there, among all that were looked at (an a-contrario test: Desolneux,
  Moisan and Morel, "Meaningful alignments", 2000);
- residuals: how far whole edges are from the model, beyond their covariance;
- contrast: the gradient along the explained edges, over that of the picture's edges;
- rivals: the log-likelihood over that of the best other pose or model at the same place that is not
  the same by symmetry.

The thresholds lie between what was measured on rendered scenes of five solids and on real pictures:
at the true pose 0.83 to 0.99 of the visible edges are explained, 0.46 to 0.75 with 30 % of them
hidden, and they fit to 0.02 to 0.4 px; other solids explain 0.6, or more and fit to 0.6 px.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import betainc, gammaln

from ..geometry import host_exponentials
from ..modeling import ObjectModel, SeenViews
from .edge_lines import EXPLAINED_DISTANCE, MIN_POINT_SIGMA, EdgeLines, poses_on_edges
from .edge_lookup import EdgeLookup
from .refinement import measured_lines
from .wireframe import Wireframe

ACCEPTED_SHARE, REJECTED_SHARE = 0.82, 0.4
"""Explained shares from which a pose may be accepted, and below which it is rejected."""

EXACT_EDGE_RMS = 0.5
"""Largest RMS distance of the measured edges from the model, px, of a pose that fits exactly."""

LOOSE_SHARE = 0.88
"""Explained share from which a pose may be accepted that does not fit exactly.

The outline of another object and the print on it were taken for a model by 82 % of its edges.
"""

HIDDEN_SHARE = 0.5
"""Explained share from which a pose may be accepted whose other edges something hides.

Then chance has to be out of the question, and much of what is missing has to be of edges that end
somewhere. A model of another height than the object has edges that are there and edges that are
not.
"""

PARTLY_HIDDEN = 0.3
"""Smallest part of the missing length that is of edges of which a part is there."""

PARTLY_SHARES = (0.1, 0.92)
"""Explained shares between which a part of an edge is there."""

CERTAIN_LOG_FALSE_ALARMS = -18.0
"""Decimal logarithm of false alarms up to which chance is out of the question.

Here exactness counts: that chance explains so much, and by edges that fit so well. Other solids
reached -17.7 with `EXACT_EDGE_RMS`, in some 140 scenes and pictures.
"""

ACCEPTED_VIEW_SHARE = 0.45
"""Smallest explained share in each view in which enough of the object is seen."""

MIN_VIEW_PX = 60.0
"""Visible edge length, px, from which a view is judged by its own share."""

MIN_EDGES = 5
"""Smallest number of measured edges, all views together, of a pose that is not rejected."""

MIN_LOG_LIKELIHOOD = 25.0
"""Smallest log-likelihood, over that of clutter, of a pose that is not rejected."""

ACCEPTED_EDGES, ACCEPTED_LOG_LIKELIHOOD = 7, 45.0
"""Smallest number of edges and log-likelihood, over that of clutter, of an accepted pose."""

MIN_IN_PICTURE = 0.7
"""Smallest part of the vertices that are within the picture in some view, of an accepted pose."""

MAX_LOG_FALSE_ALARMS = -2.0
"""Largest decimal logarithm of the expected number of false alarms of an accepted pose."""

MAX_EDGE_RMS = 1.2
"""Largest RMS distance of the measured edges of an accepted pose from the model, px."""

MIN_CONTRAST = 0.35
"""Smallest median gradient along explained edges, over the median of the picture's edge points."""

MAX_RELATIVE_STD = 0.04
"""Largest standard deviation of a vertex of an accepted pose, over the extent of the object."""

MIN_MARGIN = 6.0
"""Smallest log-likelihood over that of the best rival of an accepted pose."""

CHANCE_POSES = 48
"""Number of displaced poses from which chance is estimated."""

FOUND_PROBABILITY = 0.9
"""Probability that a piece of a truly visible edge has an edge point: shadows and equal brightness
on both sides take the rest."""

INDEPENDENT_LENGTH = 12.0
"""Length of an edge, px, whose being found or not counts as one observation."""


class Chance(NamedTuple):
    """The explained share of a wireframe at places where the object is not.

    Attributes:
        mean, std: of the shares.
    """

    mean: float
    std: float

    def probability_above(self, share: float) -> float:
        """Return the probability that chance explains at least a share.

        A beta distribution of the same mean and standard deviation stands for the tail, in which
        there are no samples.
        """
        mean = float(np.clip(self.mean, 0.02, 0.98))
        variance = float(np.clip(self.std**2, 1e-4, 0.8 * mean * (1.0 - mean)))
        count = mean * (1.0 - mean) / variance - 1.0
        # 1 - I_x(a, b) = I_(1-x)(b, a), which keeps its digits where it is small.
        return float(betainc((1.0 - mean) * count, mean * count, 1.0 - min(share, 1.0)))


class Evidence(NamedTuple):
    """The numbers of a pose that a verdict rests on, without comparing it with others.

    Attributes:
        explained: share of the visible edge length with an edge point, all views together.
        explained_in_view: likewise in each view; NaN where too little of the object is visible.
        visible_px: visible edge length of all views, px.
        edges: number of measured edges, each view for itself.
        partly_hidden: part of the missing length that is of edges of which a part is there.
        edge_rms: RMS distance of measured edges from the model, px.
        contrast: see `MIN_CONTRAST`.
        in_picture: part of the vertices within the picture, in the view that has most of them.
        log_likelihood: of the visible edges being found or not, over their being clutter.
    """

    explained: float
    explained_in_view: tuple[float, ...]
    visible_px: float
    edges: int
    partly_hidden: float
    edge_rms: float
    contrast: float
    in_picture: float
    log_likelihood: float


class Verdict(NamedTuple):
    """A decision about a pose, its reasons in words, and its numbers.

    Attributes:
        decision: "accepted", "rejected" or "open".
        reasons: why it is not accepted; empty if it is.
        evidence: of the pose itself.
        log_false_alarms: decimal logarithm of the expected number of poses that chance explains so
            well, among all that were looked at.
        margin: log-likelihood over that of the best rival; infinite without one.
    """

    decision: str
    reasons: tuple[str, ...]
    evidence: Evidence
    log_false_alarms: float
    margin: float


class ChancePoses(NamedTuple):
    """The poses to which a displaced wireframe is drawn by what the pictures show.

    Attributes:
        world_from_object: the poses.
        lengths: visible edge length of each, and the part of it that is explained, px.
    """

    world_from_object: Float[np.ndarray, "poses 4 4"]
    lengths: Float[np.ndarray, "poses 2"]


def chance_poses(
    pose: Float[np.ndarray, "4 4"],
    model: ObjectModel,
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    seed: int = 0,
) -> ChancePoses:
    """Return poses at which a model is looked for in vain, drawn to the edges of the pictures.

    The wireframe is displaced by half its size to three times its size, turned by up to 40 degrees
    and drawn to the best place near by, as a hypothesis is.

    Args:
        pose: of the object about which it is displaced.
        model: of the object.
        wireframe: of the model; few samples are enough.
        views: camera and poses.
        lookup: edge points of the views.
        seed: of the displacements.
    """
    rng = np.random.default_rng(seed)
    extent = float(np.ptp(model.vertices, axis=0).max())
    tangents = np.zeros((CHANCE_POSES, 6))
    directions = rng.standard_normal((CHANCE_POSES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tangents[:, :3] = rng.uniform(0.5, 3.0, (CHANCE_POSES, 1)) * extent * directions
    axes = rng.standard_normal((CHANCE_POSES, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    tangents[:, 3:] = rng.uniform(0.0, np.deg2rad(40.0), (CHANCE_POSES, 1)) * axes
    # Displaced about the object's middle, not about the origin of its frame.
    middle = _middle_frame(model)
    displaced = pose @ middle @ host_exponentials(tangents) @ np.linalg.inv(middle)
    return ChancePoses(*poses_on_edges(wireframe, views, lookup, displaced))


def chance_of(pose: Float[np.ndarray, "4 4"], model: ObjectModel, tried: ChancePoses) -> Chance:
    """Return how much of a wireframe's visible length other places of the pictures explain.

    Poses that returned to the object itself are left out, and so are those of which the pictures
    show nothing.

    Args:
        pose: of the object that is judged.
        model: of the object.
        tried: where its wireframe was drawn to, displaced from this pose or from another one.
    """
    middle = _middle_frame(model)
    moved = tried.world_from_object @ middle - pose @ middle
    extent = float(np.ptp(model.vertices, axis=0).max())
    elsewhere = np.linalg.norm(moved[:, :3, 3], axis=1) > 0.3 * extent
    shares = tried.lengths[:, 1] / np.maximum(tried.lengths[:, 0], 1.0)
    values = shares[elsewhere & (shares > 0.0)]
    if len(values) < 5:
        # Nothing else is in the pictures: chance explains next to nothing.
        return Chance(0.05, 0.05)
    return Chance(float(values.mean()), float(values.std(ddof=1)))


def _middle_frame(model: ObjectModel) -> Float[np.ndarray, "4 4"]:
    """Return object_from_middle, with the middle of the vertices as the origin."""
    middle = np.eye(4)
    middle[:3, 3] = model.vertices.mean(axis=0)
    return middle


def evidence_of(
    pose: Float[np.ndarray, "4 4"],
    wireframe: Wireframe,
    views: SeenViews,
    lookup: EdgeLookup,
    strengths: Sequence[Float[np.ndarray, "_"]],
    chance: float,
) -> Evidence:
    """Return what the pictures say for and against a pose.

    Args:
        pose: world_from_object.
        wireframe: of the model.
        views: camera and poses.
        lookup: edge points of the views.
        strengths: gradients of all edge points of each view, grey levels per px.
        chance: share of visible length that clutter explains.
    """
    lines = measured_lines(wireframe, views, lookup, pose, EXPLAINED_DISTANCE)
    visible, explained = lines.visible_px.sum(axis=1), lines.explained_px.sum(axis=1)
    in_view = np.where(visible >= MIN_VIEW_PX, explained / np.maximum(visible, 1.0), np.nan)
    numbers = lines.offsets[lines.measured]
    total, share = float(visible.sum()), float(explained.sum() / max(visible.sum(), 1.0))
    return Evidence(
        share,
        tuple(in_view.tolist()),
        total,
        int(lines.measured.sum()),
        _partly_hidden(lines),
        # The two numbers are distances at the mean and at the spread: their squares add up.
        float(np.sqrt((numbers**2).sum(axis=1).mean())) if len(numbers) else np.inf,
        _contrast(lines, strengths),
        float(lines.in_picture.max()),
        log_likelihood_of(share, total, chance),
    )


def _partly_hidden(lines: EdgeLines) -> float:
    """Return the part of the missing length that is of edges of which a part is there."""
    missing = lines.visible_px - lines.explained_px
    shares = lines.explained_px / np.maximum(lines.visible_px, 1.0)
    partly = (shares > PARTLY_SHARES[0]) & (shares < PARTLY_SHARES[1])
    return float(missing[partly].sum() / max(missing.sum(), 1.0))


def log_likelihood_of(share: float, visible_px: float, chance: float) -> float:
    """Return the log-likelihood of found and missing edge length over that of clutter."""
    # Each piece is found with probability q if the object is there, and with p if clutter is:
    #   l = n (x log(q / p) + (1 - x) log((1 - q) / (1 - p)))
    p, q = float(np.clip(chance, 0.02, 0.8)), FOUND_PROBABILITY
    pieces = visible_px / INDEPENDENT_LENGTH
    return pieces * (share * np.log(q / p) + (1.0 - share) * np.log((1.0 - q) / (1.0 - p)))


def _contrast(lines: EdgeLines, strengths: Sequence[Float[np.ndarray, "_"]]) -> float:
    """Return the gradient along measured edges, over that of all edge points."""
    if not lines.measured.any():
        return 0.0
    usual = np.array([np.median(one) if len(one) else np.inf for one in strengths])
    ratios = lines.strength / usual[:, None]
    return float(np.median(ratios[lines.measured]))


def relative_std(model: ObjectModel, covariance: Float[np.ndarray, "6 6"]) -> float:
    """Return the largest standard deviation of a vertex at a pose, over the object's extent."""
    # A tangent (v, w) moves the vertex p by v + w x p.
    turns = np.cross(np.eye(3)[None], model.vertices[:, None])
    moves = np.concatenate([np.tile(np.eye(3), (len(turns), 1, 1)), turns], axis=1)
    spread = moves.swapaxes(1, 2) @ covariance @ moves
    extent = float(np.ptp(model.vertices, axis=0).max())
    return float(np.sqrt(np.linalg.eigvalsh(spread)[:, -1].max())) / extent


def judge(
    evidence: Evidence,
    chance: Chance,
    tested: int,
    margin: float,
    rival: str = "another pose",
    uncertainty: float = 0.0,
) -> Verdict:
    """Return the verdict on a pose.

    Args:
        evidence: of the pose.
        chance: of the same wireframe elsewhere in the same pictures.
        tested: number of poses that were looked at.
        margin: log-likelihood over that of the best rival; infinite without one.
        rival: what the best rival is, in words.
        uncertainty: `relative_std` of the pose.
    """
    # Expected number of false alarms: tested poses times the probability of each.
    probability = max(chance.probability_above(evidence.explained), 1e-300)
    log_false_alarms = float(np.log10(max(tested, 1)) + np.log10(probability))
    share, rms = evidence.explained, evidence.edge_rms
    against = []
    if share < REJECTED_SHARE:
        against.append(f"only {share:.0%} of its visible edges are in the pictures")
    if log_false_alarms > 0.0:
        against.append(
            f"clutter explains as much: {chance.mean:.0%} +- {chance.std:.0%} elsewhere, "
            f"{share:.0%} here"
        )
    if evidence.edges < MIN_EDGES or evidence.log_likelihood < MIN_LOG_LIKELIHOOD:
        against.append(
            f"only {evidence.edges} edges of {evidence.visible_px:.0f} px speak for it, too few"
        )
    if against:
        return Verdict("rejected", tuple(against), evidence, log_false_alarms, margin)
    doubts = []
    is_certain = _is_certain(evidence, log_false_alarms)
    if share < _accepted_share(evidence, is_certain):
        loosely = f", and fit to {rms:.2f} px" if share >= ACCEPTED_SHARE else ""
        doubts.append(f"only {share:.0%} of its visible edges are in the pictures{loosely}")
    if evidence.edges < ACCEPTED_EDGES or evidence.log_likelihood < ACCEPTED_LOG_LIKELIHOOD:
        doubts.append(f"{evidence.edges} edges of {evidence.visible_px:.0f} px are few")
    seen = sum(np.isfinite(evidence.explained_in_view))
    if seen < min(2, len(evidence.explained_in_view)):
        doubts.append(f"only {seen} of {len(evidence.explained_in_view)} views show it")
    if evidence.in_picture < MIN_IN_PICTURE:
        doubts.append(f"only {evidence.in_picture:.0%} of it are within a picture")
    doubts += [
        f"view {k}: {one:.0%} of its visible edges are in the picture"
        for k, one in enumerate(evidence.explained_in_view)
        if one < ACCEPTED_VIEW_SHARE
    ]
    if log_false_alarms > MAX_LOG_FALSE_ALARMS and not is_certain:
        doubts.append(f"{10.0**log_false_alarms:.2g} such poses are expected by chance")
    if rms > MAX_EDGE_RMS:
        doubts.append(f"its edges are {rms:.2f} px (RMS) from those of the pictures")
    if evidence.contrast < MIN_CONTRAST:
        doubts.append(f"its edges have {evidence.contrast:.2f} of the pictures' usual contrast")
    if uncertainty > MAX_RELATIVE_STD:
        doubts.append(f"its pose is uncertain by {uncertainty:.0%} of its size")
    if margin < MIN_MARGIN:
        doubts.append(f"ambiguous: {rival} explains the pictures nearly as well")
    return Verdict(
        "open" if doubts else "accepted", tuple(doubts), evidence, log_false_alarms, margin
    )


def _is_certain(evidence: Evidence, log_false_alarms: float) -> bool:
    """Return whether chance is out of the question, because so many edges fit exactly."""
    exactness = log_chance_of_exactness(evidence.edge_rms, evidence.edges)
    is_exact = evidence.edge_rms <= EXACT_EDGE_RMS
    return is_exact and log_false_alarms + exactness <= CERTAIN_LOG_FALSE_ALARMS


def _accepted_share(evidence: Evidence, is_certain: bool) -> float:
    """Return the explained share from which a pose may be accepted, given how well it fits."""
    if evidence.edge_rms > EXACT_EDGE_RMS:
        return LOOSE_SHARE
    is_hidden = is_certain and evidence.partly_hidden >= PARTLY_HIDDEN
    return HIDDEN_SHARE if is_hidden else ACCEPTED_SHARE


def log_chance_of_exactness(rms: float, edges: int) -> float:
    """Return the decimal logarithm of the probability that edges of clutter fit so well.

    Two numbers of each edge, less the six of the pose, are anywhere within `EXPLAINED_DISTANCE` by
    chance (Moisan and Stival, "A probabilistic criterion to detect rigid point matches", 2004).
    """
    # The ball sum x^2 <= n r^2 has the part pi^(n/2) (r sqrt(n))^n / Gamma(n/2 + 1) of the cube
    # (2 d)^n.
    n = 2 * edges - 6
    if n <= 0:
        return 0.0
    radius = max(rms, MIN_POINT_SIGMA) / np.sqrt(2.0) * np.sqrt(n)
    part = 0.5 * n * np.log(np.pi) + n * np.log(radius / (2.0 * EXPLAINED_DISTANCE))
    return min(float((part - gammaln(0.5 * n + 1.0)) / np.log(10.0)), 0.0)
