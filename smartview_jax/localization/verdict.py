"""Judge whether an object is where a pose says: accepted, rejected or open, with the numbers.

The test has six parts, each with a threshold that is a constant below and a number in `Verdict`:

- the explained share: of the visible edge length, the part that has an edge point within
  `EXPLAINED_DISTANCE`, of the edge's orientation; in all views together and in each;
- chance: the share that the same wireframe explains at other places of the same pictures, after the
  same convergence. A beta distribution of these shares gives the expected number of poses so well
  explained by what else is there, among all that were looked at (an a-contrario test: Desolneux,
  Moisan and Morel, "Meaningful alignments", 2000);
- residuals: how far whole edges are from the model, beyond their covariance;
- sizes: where edges are missing, whether a face that is elsewhere would explain more, because what
  is there is a solid of another size (`moved_faces`);
- contrast: the gradient along the explained edges, over that of the picture's edges;
- rivals: the log-likelihood, with how exactly the edges fit, over that of the best other pose or
  model at the same place that is not the same by symmetry.

The thresholds lie between what was measured on rendered scenes of five solids and on real pictures:
at the true pose 0.83 to 0.99 of the visible edges are explained, 0.46 to 0.75 with 30 % of them
hidden, and they fit to 0.02 to 0.4 px; other solids explain 0.6, or fit to no better than 0.6 px,
but for those of another size, which fit exactly.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..modeling import ObjectModel
from .chance import Chance
from .evidence import MAX_CHANCE, Evidence, log_likelihood_of_found
from .moved_faces import MovedFace

ACCEPTED_SHARE, REJECTED_SHARE = 0.82, 0.4
"""Explained shares from which a pose may be accepted, and below which it is rejected."""

EXACT_EDGE_RMS = 0.5
"""Largest RMS distance of the measured edges from the model, px, of a pose that fits exactly."""

LOOSE_SHARE = 0.88
"""Explained share from which a pose may be accepted that does not fit exactly, or in one picture
not so exactly that chance is out of the question.

The outline of another object and the print on it were taken for a model by 82 % of its edges. One
picture leaves the scale free, too: of 84 searches for boxes in pictures of a textured cube, and of
others, 11 ended in a pose with 82 to 91 %, at edges of the cube and of its print.
"""

HIDDEN_SHARE = 0.5
"""Explained share from which a pose may be accepted whose other edges something hides.

Then chance has to be out of the question, and the model needs faces, so that it can be asked
whether one of them is elsewhere.
"""

ALONE_LOG_EXACTNESS = -9.0
"""Decimal logarithm of the chance that edges fit so well, up to which one picture is enough.

One picture leaves the scale free. In 180 single pictures of other seeds 28 of 29 right poses of
objects that are hidden in part had -9.7 or less; at other solids, and at print, -5.1 to -5.6 and
once -10.1.
"""

COMPLETE_SHARE = 0.9
"""Explained share from which nothing has to be hidden, and no face is asked for elsewhere."""

MAX_LOG_MOVED = 12.0
"""Largest log-likelihood of a solid with a face elsewhere, over that of the model, of an accepted
pose.

It is `MIN_MARGIN`, and about 6 more for the hundreds of places that are tried. In 120 scenes of six
solids each that are like the model but for some sizes 160 of 164 wrong poses that fit exactly had
14.8 or more; of 59 right poses of objects that are hidden by some 30 % none had more than 10.5.
"""

MIN_CHANCE_BESIDE = 0.25
"""Smallest probability that clutter explains a piece of an edge of a moved face.

Where another solid stands, more of them do.
"""

CERTAIN_LOG_FALSE_ALARMS = -18.0
"""Decimal logarithm of false alarms up to which chance is out of the question.

Here exactness counts: that chance explains so much, and by edges that fit so well. Other solids
reached -17.7 with `EXACT_EDGE_RMS`, in some 140 scenes and pictures.
"""

ACCEPTED_VIEW_SHARE = 0.45
"""Smallest explained share in each of the views that an accepted pose needs."""

MIN_GOOD_VIEWS = 2
"""Number of views that have to show the object and explain that much, or all where there are fewer.

In a further one something may be before the object: of six objects in bins that two views had shown
a third one showed 23 to 44 % of the edges.
"""

MIN_EDGES = 5
"""Smallest number of measured edges, all views together, of a pose that is not rejected."""

MIN_LOG_LIKELIHOOD = 25.0
"""Smallest log-likelihood, over that of clutter, of a pose that is not rejected."""

ACCEPTED_EDGES, ACCEPTED_LOG_LIKELIHOOD = 7, 45.0
"""Smallest number of edges and log-likelihood, over that of clutter, of an accepted pose.

How exactly the edges fit does not count here: with it one of 100 objects that are not in the
pictures was accepted, of which as little was explained.
"""

SMALL_LOG_LIKELIHOOD = 35.0
"""Likewise, of a pose with `LOOSE_SHARE` of its edges that fits exactly.

Small objects have no more edge length. In 180 single pictures of other seeds and 96 searches of
single pictures of the castle, boxes of other sizes included, the wrong poses so complete and exact
all had 140 or more, so that this limit lets none of them in.
"""

SUFFICIENT_LOG_ODDS = 160.0
"""Log-likelihood, exactness included, from which fewer edges are enough, if they fit exactly.

A block shows five or six long edges in some pictures. In 360 single pictures rendered of other
scenes 28 right poses were open for that alone, 18 of them with more than this; of the wrong
ones with so few edges one that fits to 0.44 px reached 144, and one that fits to 0.55 px 173.
"""

MIN_IN_PICTURE = 0.7
"""Smallest part of the vertices that are within the picture in some view, of an accepted pose."""

MIN_IN_FRONT = 0.3
"""Smallest part of the edges of an accepted pose that no other object hides."""

MAX_LOG_FALSE_ALARMS = -2.0
"""Largest decimal logarithm of the expected number of false alarms of an accepted pose."""

MAX_EDGE_RMS, ALONE_EDGE_RMS = 1.2, 0.53
"""Largest RMS distance of the measured edges from the model, px, of an accepted pose; the second of
one that a single picture shows.

With scale and tilt free, boxes of other sizes were fitted to 91 to 98 % of the edges of a castle's
cube and of rendered solids in single pictures, to 0.55 px or more; right poses fit to 0.50 or less.
"""

MIN_CONTRAST = 0.35
"""Smallest median gradient along explained edges, over the median of the picture's edge points."""

MAX_RELATIVE_STD = 0.04
"""Largest standard deviation of a vertex of an accepted pose, over the extent of the object."""

MIN_MARGIN = 6.0
"""Smallest log-likelihood over that of the best rival of an accepted pose, exactness included."""


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

    decision: Literal["accepted", "rejected", "open"]
    reasons: tuple[str, ...]
    evidence: Evidence
    log_false_alarms: float
    margin: float


def relative_std(model: ObjectModel, covariance: Float[np.ndarray, "6 6"]) -> float:
    """Return the largest standard deviation of a vertex at a pose, over the object's extent."""
    # A tangent (v, w) moves the vertex p by v + w x p.
    turns = np.cross(np.eye(3)[None], model.vertices[:, None])
    moves = np.concatenate([np.tile(np.eye(3), (len(turns), 1, 1)), turns], axis=1)
    spread = moves.swapaxes(1, 2) @ covariance @ moves
    return float(np.sqrt(np.linalg.eigvalsh(spread)[:, -1].max())) / model.extent


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
    # Expected number of false alarms: tested poses times the probability of each. Of what other
    # objects hide in part, less edge length is left that chance has to explain.
    own = chance._replace(std=chance.std / max(evidence.in_front, 0.01) ** 0.5)
    probability = max(own.probability_above(evidence.explained), 1e-300)
    log_false_alarms = float(np.log10(max(tested, 1)) + np.log10(probability))
    share, rms = evidence.explained, evidence.edge_rms
    is_certain = _is_certain(evidence, log_false_alarms)
    against = []
    if share < REJECTED_SHARE:
        against.append(f"only {share:.0%} of its visible edges are in the pictures")
    # Much else may explain as much, but not by edges that fit so well.
    if log_false_alarms > 0.0 and not is_certain:
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
    if share < _accepted_share(evidence, is_certain):
        more = f", and fit to {rms:.2f} px" if share >= ACCEPTED_SHARE else ""
        doubts.append(f"only {share:.0%} of its visible edges are in the pictures{more}")
    few_will_do = rms <= EXACT_EDGE_RMS and evidence.log_odds >= SUFFICIENT_LOG_ODDS
    is_few = evidence.edges < ACCEPTED_EDGES and not few_will_do
    if is_few or evidence.log_likelihood < _accepted_log_likelihood(evidence):
        doubts.append(f"{evidence.edges} edges of {evidence.visible_px:.0f} px are few")
    in_view = evidence.explained_in_view
    seen, needed = sum(np.isfinite(in_view)), min(MIN_GOOD_VIEWS, len(in_view))
    if seen < needed:
        doubts.append(f"only {seen} of {len(in_view)} views show it")
    if evidence.in_picture < MIN_IN_PICTURE:
        doubts.append(f"only {evidence.in_picture:.0%} of it are within a picture")
    if evidence.in_front < MIN_IN_FRONT:
        doubts.append(f"only {evidence.in_front:.0%} of its edges are not behind other objects")
    if sum(one >= ACCEPTED_VIEW_SHARE for one in in_view) < needed:
        doubts += [
            f"view {k}: {one:.0%} of its visible edges are in the picture"
            for k, one in enumerate(in_view)
            if one < ACCEPTED_VIEW_SHARE
        ]
    if log_false_alarms > MAX_LOG_FALSE_ALARMS and not is_certain:
        doubts.append(f"{10.0**log_false_alarms:.2g} such poses are expected by chance")
    if rms > (ALONE_EDGE_RMS if evidence.is_alone else MAX_EDGE_RMS):
        more = ", too far for pictures from one direction" if evidence.is_alone else ""
        doubts.append(f"its edges are {rms:.2f} px (RMS) from those of the pictures{more}")
    if evidence.contrast < MIN_CONTRAST:
        doubts.append(f"its edges have {evidence.contrast:.2f} of the pictures' usual contrast")
    if uncertainty > MAX_RELATIVE_STD:
        doubts.append(f"its pose is uncertain by {uncertainty:.0%} of its size")
    if evidence.moved is not None and _log_moved(evidence.moved, chance) > MAX_LOG_MOVED:
        face, distance = evidence.moved.face, 1e3 * evidence.moved.distance
        # It is known to a step only.
        length = f"{abs(distance):.{0 if abs(distance) >= 1.0 else 1}f} mm"
        way = "out" if distance > 0.0 else "in"
        doubts.append(
            f"another size: with face {face} moved {way} by {length}, it would explain more of the "
            "pictures"
        )
    if margin < MIN_MARGIN:
        doubts.append(f"ambiguous: {rival} explains the pictures nearly as well")
    return Verdict(
        "open" if doubts else "accepted", tuple(doubts), evidence, log_false_alarms, margin
    )


def _is_certain(evidence: Evidence, log_false_alarms: float) -> bool:
    """Return whether chance is out of the question, because so many edges fit exactly."""
    is_exact = evidence.edge_rms <= EXACT_EDGE_RMS
    return is_exact and log_false_alarms + evidence.log_exactness <= CERTAIN_LOG_FALSE_ALARMS


def _accepted_share(evidence: Evidence, is_certain: bool) -> float:
    """Return the explained share from which a pose may be accepted, given how well it fits."""
    is_sure_alone = is_certain and evidence.log_exactness <= ALONE_LOG_EXACTNESS
    if evidence.edge_rms > EXACT_EDGE_RMS or (evidence.is_alone and not is_sure_alone):
        return LOOSE_SHARE
    return HIDDEN_SHARE if is_certain and evidence.has_faces else ACCEPTED_SHARE


def _accepted_log_likelihood(evidence: Evidence) -> float:
    """Return the log-likelihood over clutter from which a pose may be accepted."""
    is_small = evidence.explained >= LOOSE_SHARE and evidence.edge_rms <= EXACT_EDGE_RMS
    return SMALL_LOG_LIKELIHOOD if is_small else ACCEPTED_LOG_LIKELIHOOD


def may_be_another_size(evidence: Evidence) -> bool:
    """Return whether so much is missing that a face of what is there may be elsewhere."""
    return evidence.explained < COMPLETE_SHARE and evidence.has_faces


def _log_moved(moved: MovedFace, chance: Chance) -> float:
    """Return the log-likelihood of the solid with the moved face over that of the model."""
    beside = float(np.clip(chance.mean, MIN_CHANCE_BESIDE, MAX_CHANCE))
    return log_likelihood_of_found(moved.gained_px, beside)
