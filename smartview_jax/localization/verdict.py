"""Judge whether an object is at a pose: accepted, rejected or open, with the numbers.

The test has seven parts, each with a threshold below and a number in `Verdict`:

- the explained share: the share of the visible edge length with an edge point within
  `EXPLAINED_DISTANCE` and with the edge's orientation; in all views together and in each;
- chance: the share that the same wireframe explains at other places of the same pictures, after the
  same convergence. A beta distribution of these shares gives the expected number of poses that
  clutter explains as well, among all poses that were examined (an a-contrario test: Desolneux,
  Moisan and Morel, "Meaningful alignments", 2000);
- residuals: how far whole edges are from the model, beyond their covariance;
- sizes: where edges are missing, whether the model with a moved face would explain more, because
  the object has other dimensions (`moved_faces`);
- agreement: whether each view alone puts the object where the others do (`view_agreement`);
- contrast: the gradient along the explained edges, over the picture's median edge gradient;
- rivals: the log-likelihood ratio, including the exactness of the fit, to the best other pose or
  model at the same place that symmetry does not make equal.

The thresholds were chosen between values measured on rendered scenes of five solids and on real
pictures: at the true pose 0.83 to 0.99 of the visible edges are explained, 0.46 to 0.75 when 30 %
of them are occluded, and they fit to 0.02 to 0.4 px; other solids explain 0.6, or fit to no better
than 0.6 px, except solids of other dimensions, which fit exactly.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..modeling import ObjectModel
from .chance import Chance
from .distinct_poses import surface_sigma
from .evidence import MAX_CHANCE, Evidence, log_likelihood_of_found
from .moved_faces import MovedFace
from .view_agreement import EXACT_RIG_ERROR, MIN_AGREEMENT, ViewDisagreement

ACCEPTED_SHARE, REJECTED_SHARE = 0.82, 0.4
"""Explained shares above which a pose may be accepted, and below which it is rejected."""

EXACT_EDGE_RMS = 0.5
"""Largest RMS distance of the measured edges from the model, px, that counts as an exact fit."""

LOOSE_SHARE = 0.88
"""Explained share above which a pose may be accepted that does not fit exactly or, in one picture,
not so exactly that chance can be excluded.

The outline of another object and the print on it matched 82 % of a model's edges. One picture
leaves the scale free, too: of 84 searches for boxes in pictures of a textured cube, and of others,
11 ended in a pose with 82 to 91 %, on edges of the cube and of its print.
"""

HIDDEN_SHARE = 0.5
"""Explained share above which a pose may be accepted if its other edges are occluded.

Chance must then be excluded, and the model needs faces, so that other dimensions can be tested.
"""

ALONE_LOG_EXACTNESS = -9.0
"""Largest decimal logarithm of the chance of so exact a fit for which one picture is enough.

One picture leaves the scale free. In 180 single pictures of other seeds 28 of 29 right poses of
partly occluded objects had -9.7 or less; at other solids, and at print, -5.1 to -5.6 and once
-10.1.
"""

COMPLETE_SHARE = 0.9
"""Explained share above which nothing needs to be occluded, and moved faces are not tested."""

MAX_LOG_MOVED = 12.0
"""Largest log-likelihood ratio of the solid with a moved face to the model, in an accepted pose.

It is `MIN_MARGIN` plus about 6 for the hundreds of distances that are tried. In 120 scenes of six
solids each that differ from the model in some dimensions, 160 of 164 wrong poses that fit exactly
had 14.8 or more; of 59 right poses of objects occluded by some 30 % none had more than 10.5.
"""

MIN_CHANCE_BESIDE = 0.25
"""Smallest probability that clutter explains a piece of an edge of a moved face.

Next to another solid, clutter explains more.
"""

CERTAIN_LOG_FALSE_ALARMS = -18.0
"""Decimal logarithm of the number of false alarms below which chance can be excluded.

It includes exactness: the chance that so much is explained, by edges that fit so well. Other solids
reached -17.7 with `EXACT_EDGE_RMS`, in some 140 scenes and pictures.
"""

ACCEPTED_VIEW_SHARE = 0.45
"""Smallest explained share in each counted view of an accepted pose."""

MIN_GOOD_VIEWS = 2
"""Number of views that must show the object with at least that share; all, if there are fewer.

In a further view the object may be occluded: of six objects in bins that two views had shown, a
third view showed 23 to 44 % of the edges.
"""

MIN_EDGES = 5
"""Smallest number of measured edges, all views together, of a pose that is not rejected."""

MIN_LOG_LIKELIHOOD = 25.0
"""Smallest log-likelihood ratio to clutter of a pose that is not rejected."""

ACCEPTED_EDGES, ACCEPTED_LOG_LIKELIHOOD = 7, 45.0
"""Smallest number of edges and log-likelihood ratio to clutter of an accepted pose.

The exactness of the fit is not included here: with it one of 100 objects that are not in the
pictures was accepted, with equally few explained edges.
"""

SMALL_LOG_LIKELIHOOD = 35.0
"""The same for a pose that fits exactly with `LOOSE_SHARE` of its edges.

Small objects have less edge length. In 180 single pictures of other seeds and 96 searches of
single pictures of the castle, including boxes of other sizes, all wrong poses as complete and exact
had 140 or more, so that this limit lets none of them in.
"""

SUFFICIENT_LOG_ODDS = 160.0
"""Log-likelihood ratio, with exactness, above which fewer edges are enough if they fit exactly.

A block shows five or six long edges in some pictures. In 360 single pictures rendered of other
scenes 28 right poses were open only for this reason, 18 of them with more than this; among the
wrong ones with so few edges one that fits to 0.44 px reached 144, and one that fits to 0.55 px 173.
"""

MIN_IN_PICTURE = 0.7
"""Smallest share of the vertices within the picture, in at least one view of an accepted pose."""

MIN_IN_FRONT = 0.3
"""Smallest share of the edges of an accepted pose that no other object occludes."""

MAX_LOG_FALSE_ALARMS = -2.0
"""Largest decimal logarithm of the expected number of false alarms of an accepted pose."""

MAX_EDGE_RMS, ALONE_EDGE_RMS = 1.2, 0.53
"""Largest RMS distance of the measured edges from the model, px, in an accepted pose; the second
value is for an object shown from one direction only.

With scale and tilt free, boxes of other sizes were fitted to 91 to 98 % of the edges of a castle's
cube and of rendered solids in single pictures, to 0.55 px or more; right poses fit to 0.50 or less.
"""

MIN_CONTRAST = 0.35
"""Smallest median gradient along explained edges, over the median of the picture's edge points."""

MAX_RELATIVE_STD = 0.04
"""Largest standard deviation of a vertex in an accepted pose, over the object's extent."""

MIN_MARGIN = 6.0
"""Smallest log-likelihood ratio to the best rival of an accepted pose, including exactness."""


class Verdict(NamedTuple):
    """A decision about a pose, its reasons in words, and its numbers.

    Attributes:
        decision: "accepted", "rejected" or "open".
        reasons: why it is not accepted; empty if it is.
        evidence: of the pose itself.
        log_false_alarms: decimal logarithm of the expected number of poses that clutter explains as
            well, among all that were examined.
        margin: log-likelihood ratio to the best rival; infinite without one.
    """

    decision: Literal["accepted", "rejected", "open"]
    reasons: tuple[str, ...]
    evidence: Evidence
    log_false_alarms: float
    margin: float


def relative_std(model: ObjectModel, covariance: Float[np.ndarray, "6 6"]) -> float:
    """Return the largest standard deviation of a vertex at a pose, over the object's extent."""
    return surface_sigma(model, covariance) / model.extent


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
        chance: explained share of the same wireframe elsewhere in the same pictures.
        tested: number of poses that were examined.
        margin: log-likelihood ratio to the best rival; infinite without one.
        rival: name of the best rival, in messages.
        uncertainty: `relative_std` of the pose.
    """
    # Expected number of false alarms: examined poses times the probability of each. A partly
    # occluded object has less visible edge length, so that its explained share scatters more by
    # chance.
    scaled = chance._replace(std=chance.std / max(evidence.in_front, 0.01) ** 0.5)
    probability = max(scaled.probability_above(evidence.explained), 1e-300)
    log_false_alarms = float(np.log10(max(tested, 1)) + np.log10(probability))
    share, rms = evidence.explained, evidence.edge_rms
    is_certain = _is_certain(evidence, log_false_alarms)
    against = []
    if share < REJECTED_SHARE:
        against.append(f"only {share:.0%} of its visible edges match the pictures")
    # Clutter may explain as much elsewhere, but not with edges that fit so exactly.
    if log_false_alarms > 0.0 and not is_certain:
        against.append(
            f"background clutter matches almost as well: {share:.0%} of the edges here, "
            f"{chance.mean:.0%} +- {chance.std:.0%} elsewhere"
        )
    if evidence.edges < MIN_EDGES or evidence.log_likelihood < MIN_LOG_LIKELIHOOD:
        against.append(f"too {_little_evidence(evidence, MIN_EDGES, MIN_LOG_LIKELIHOOD)}")
    if against:
        return Verdict("rejected", tuple(against), evidence, log_false_alarms, margin)
    doubts = []
    if share < _accepted_share(evidence, is_certain):
        more = f", and these fit to {rms:.2f} px" if share >= ACCEPTED_SHARE else ""
        doubts.append(f"only {share:.0%} of its visible edges match the pictures{more}")
    # So exact a fit is no chance, however few the edges are.
    is_sufficient = evidence.log_odds >= SUFFICIENT_LOG_ODDS
    is_sufficient |= evidence.log_exactness <= ALONE_LOG_EXACTNESS
    few_will_do = rms <= EXACT_EDGE_RMS and is_sufficient
    is_few = evidence.edges < ACCEPTED_EDGES and not few_will_do
    needed_log_likelihood = _accepted_log_likelihood(evidence)
    if is_few or evidence.log_likelihood < needed_log_likelihood:
        doubts.append(_little_evidence(evidence, ACCEPTED_EDGES, needed_log_likelihood))
    in_view = evidence.explained_in_view
    showing, needed = sum(np.isfinite(in_view)), min(MIN_GOOD_VIEWS, len(in_view))
    if showing < needed:
        doubts.append(f"only {showing} of {len(in_view)} views show enough of it")
    if evidence.in_picture < MIN_IN_PICTURE:
        doubts.append(f"only {evidence.in_picture:.0%} of its vertices are within a picture")
    if evidence.in_front < MIN_IN_FRONT:
        doubts.append(f"{1.0 - evidence.in_front:.0%} of its edges are occluded by other objects")
    if sum(matched >= ACCEPTED_VIEW_SHARE for matched in in_view) < needed:
        doubts += [
            f"view {k}: {matched:.0%} of its visible edges match the picture"
            for k, matched in enumerate(in_view)
            if matched < ACCEPTED_VIEW_SHARE
        ]
    if log_false_alarms > MAX_LOG_FALSE_ALARMS and not is_certain:
        doubts.append(f"{10.0**log_false_alarms:.2g} poses as good as this are expected by chance")
    if rms > (ALONE_EDGE_RMS if evidence.is_alone else MAX_EDGE_RMS):
        more = ", too far for pictures from one direction" if evidence.is_alone else ""
        doubts.append(f"its edges are {rms:.2f} px (RMS) from the picture edges{more}")
    if evidence.contrast < MIN_CONTRAST:
        doubts.append(
            f"low contrast: its edges have {evidence.contrast:.0%} of the pictures' median edge "
            "gradient"
        )
    if uncertainty > MAX_RELATIVE_STD:
        doubts.append(f"its pose is uncertain by {uncertainty:.0%} of its size")
    if evidence.moved is not None and _log_moved(evidence.moved, chance) > MAX_LOG_MOVED:
        face, distance = evidence.moved.face, 1e3 * evidence.moved.distance
        # The distance is known to one step only.
        length = f"{abs(distance):.{0 if abs(distance) >= 1.0 else 1}f} mm"
        size, way = ("larger", "outward") if distance > 0.0 else ("smaller", "inward")
        doubts.append(
            f"the object seems {size} than the model: moving face {face} {way} by {length} matches "
            "more edges"
        )
    if evidence.disagreement is not None and _is_rig_wrong(evidence.disagreement):
        doubts.append(evidence.disagreement.message)
    if margin < MIN_MARGIN:
        doubts.append(f"ambiguous: {rival} matches the pictures almost as well")
    return Verdict(
        "open" if doubts else "accepted", tuple(doubts), evidence, log_false_alarms, margin
    )


def _is_rig_wrong(disagreement: ViewDisagreement) -> bool:
    """Return whether views disagree by more than the errors of the rig explain.

    A rig that is taken as exact errs too, by an amount that nobody stated.
    """
    is_tolerated = not disagreement.is_rig_uncertain and disagreement.relative <= EXACT_RIG_ERROR
    return disagreement.probability < MIN_AGREEMENT and not is_tolerated


def _little_evidence(evidence: Evidence, edges: int, log_likelihood: float) -> str:
    """Return in words how much evidence there is, and how much is needed."""
    return (
        f"little evidence: {evidence.edges} matched edges ({evidence.visible_px:.0f} px visible) "
        f"with a log-likelihood ratio of {evidence.log_likelihood:.3g} to clutter; {edges} and "
        f"{log_likelihood:.3g} are needed"
    )


def _is_certain(evidence: Evidence, log_false_alarms: float) -> bool:
    """Return whether chance can be excluded, because so many edges fit exactly."""
    is_exact = evidence.edge_rms <= EXACT_EDGE_RMS
    return is_exact and log_false_alarms + evidence.log_exactness <= CERTAIN_LOG_FALSE_ALARMS


def _accepted_share(evidence: Evidence, is_certain: bool) -> float:
    """Return the explained share above which a pose may be accepted, given how well it fits."""
    is_sure_alone = is_certain and evidence.log_exactness <= ALONE_LOG_EXACTNESS
    if evidence.edge_rms > EXACT_EDGE_RMS or (evidence.is_alone and not is_sure_alone):
        return LOOSE_SHARE
    return HIDDEN_SHARE if is_certain and evidence.has_faces else ACCEPTED_SHARE


def _accepted_log_likelihood(evidence: Evidence) -> float:
    """Return the log-likelihood ratio to clutter above which a pose may be accepted."""
    is_small = evidence.explained >= LOOSE_SHARE and evidence.edge_rms <= EXACT_EDGE_RMS
    return SMALL_LOG_LIKELIHOOD if is_small else ACCEPTED_LOG_LIKELIHOOD


def may_be_another_size(evidence: Evidence) -> bool:
    """Return whether so many edges are missing that other dimensions must be tested."""
    return evidence.explained < COMPLETE_SHARE and evidence.has_faces


def _log_moved(moved: MovedFace, chance: Chance) -> float:
    """Return the log-likelihood ratio of the solid with the moved face to the model."""
    clutter = float(np.clip(chance.mean, MIN_CHANCE_BESIDE, MAX_CHANCE))
    return log_likelihood_of_found(moved.gained_px, clutter)
