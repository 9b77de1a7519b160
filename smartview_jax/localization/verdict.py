"""Judge whether an object is at a pose: accepted, rejected or open, with the numbers.

A pose has to be likelier than what else may explain the edges:

- clutter, by the share of the visible edge length with an edge point within `EXPLAINED_DISTANCE`
  and with the edge's orientation, in all views together and in each, and by how exactly whole edges
  fit: the two give the expected number of poses that clutter explains as well, among all that were
  examined (an a-contrario test: Desolneux, Moisan and Morel, "Meaningful alignments", 2000);
- another solid: where edges are missing, the model with a moved face might explain more, because
  the object has other dimensions (`moved_faces`);
- another pose, or another model, at the same place that symmetry does not make equal, by the
  log-likelihood ratio including the exactness of the fit.

Its views have to agree (`view_agreement`), and it has to be precise.

The thresholds were chosen between values measured on rendered scenes of five solids and on real
pictures. On 520 other poses (of a second renderer, of drawn solids among clutter, and of real
pictures, with boxes of other proportions) most were left out in turn, and those that improved no
verdict were removed.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..modeling import ObjectModel
from .distinct_poses import surface_sigma
from .evidence import Evidence, log_likelihood_of_found
from .moved_faces import MovedFace
from .view_agreement import EXACT_RIG_ERROR, MIN_AGREEMENT, ViewDisagreement

REJECTED_SHARE = 0.4
"""Explained share below which a pose is rejected."""

ACCEPTED_SHARE = 0.88
"""Explained share above which a pose may be accepted that does not fit so exactly that clutter can
be excluded.

The outline of another object and the print on it matched 82 % of a model's edges. One picture
leaves the scale free, too: of 84 searches for boxes in pictures of a textured cube, and of others,
11 ended in a pose with 82 to 91 %, on edges of the cube and of its print.
"""

HIDDEN_SHARE = 0.5
"""Explained share above which a pose may be accepted if its other edges are occluded.

Clutter must then be excluded, and the model needs faces, so that other dimensions can be tested.
"""

CERTAIN_EDGE_RMS, CERTAIN_LOG_EXACTNESS = 0.5, -9.0
"""Largest RMS distance of the measured edges from the model, px, and largest decimal logarithm of
the chance of so exact a fit, for which clutter can be excluded.

One picture leaves the scale free. In 180 single pictures of other seeds 28 of 29 right poses of
partly occluded objects had -9.7 or less; at other solids, and at print, -5.1 to -5.6 and once
-10.1.
"""

COMPLETE_SHARE = 0.9
"""Explained share above which nothing needs to be occluded, and moved faces are not tested."""

MAX_LOG_MOVED = 12.0
"""Largest log-likelihood ratio of the solid with a moved face to the model, in an accepted pose.

About 6 of it are for the hundreds of distances that are tried. In 120 scenes of six
solids each that differ from the model in some dimensions, 160 of 164 wrong poses that fit exactly
had 14.8 or more; of 59 right poses of objects occluded by some 30 % none had more than 10.5.
"""

ACCEPTED_VIEW_SHARE = 0.45
"""Smallest explained share in each counted view of an accepted pose."""

MIN_GOOD_VIEWS = 2
"""Number of views that must show the object with at least that share; all, if there are fewer.

In a further view the object may be occluded: of six objects in bins that two views had shown, a
third view showed 23 to 44 % of the edges.
"""

MIN_EDGES = 5
"""Smallest number of measured edges, all views together, of a pose that is not rejected.

Five edges have ten numbers, four more than a pose.
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

MAX_RELATIVE_STD = 0.04
"""Largest standard deviation of a vertex in an accepted pose, over the object's extent."""

MIN_MARGIN = 8.0
"""Smallest log-likelihood ratio to the best rival of an accepted pose, including exactness.

It is ln(100) for each of some thirty poses that are examined. Right poses had 8.5 or more, wrong
ones 6.2 and 6.7 where nothing else spoke against them.
"""


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
    tested: int,
    margin: float,
    rival: str = "another pose",
    uncertainty: float = 0.0,
) -> Verdict:
    """Return the verdict on a pose.

    Args:
        evidence: of the pose.
        tested: number of poses that were examined.
        margin: log-likelihood ratio to the best rival; infinite without one.
        rival: name of the best rival, in messages.
        uncertainty: `relative_std` of the pose.
    """
    log_false_alarms = float(np.log10(max(tested, 1)) - evidence.log_odds / np.log(10.0))
    share, rms = evidence.explained, evidence.edge_rms
    against = []
    if share < REJECTED_SHARE:
        against.append(f"only {share:.0%} of its visible edges match the pictures")
    is_clutter = evidence.log_likelihood < 0.0 or log_false_alarms > 0.0
    if is_clutter or evidence.edges < MIN_EDGES:
        against.append(f"background clutter matches as well: {_amount(evidence)}")
    if against:
        return Verdict("rejected", tuple(against), evidence, log_false_alarms, margin)
    doubts = []
    if share < _accepted_share(evidence):
        more = f", and these fit to {rms:.2f} px" if share >= HIDDEN_SHARE else ""
        doubts.append(f"only {share:.0%} of its visible edges match the pictures{more}")
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
    if log_false_alarms > MAX_LOG_FALSE_ALARMS:
        doubts.append(
            f"little evidence: {_amount(evidence)}; {10.0**log_false_alarms:.2g} poses as good as "
            "this are expected by chance"
        )
    if rms > (ALONE_EDGE_RMS if evidence.is_alone else MAX_EDGE_RMS):
        more = ", too far for pictures from one direction" if evidence.is_alone else ""
        doubts.append(f"its edges are {rms:.2f} px (RMS) from the picture edges{more}")
    if uncertainty > MAX_RELATIVE_STD:
        doubts.append(f"its pose is uncertain by {uncertainty:.0%} of its size")
    if evidence.moved is not None and _log_moved(evidence.moved) > MAX_LOG_MOVED:
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


def _amount(evidence: Evidence) -> str:
    """Return in words how much of the object is seen, and how well it fits."""
    return (
        f"{evidence.edges} matched edges, {evidence.explained:.0%} of {evidence.visible_px:.0f} px "
        f"visible, off by {evidence.edge_rms:.2f} px"
    )


def _accepted_share(evidence: Evidence) -> float:
    """Return the explained share above which a pose may be accepted, given how well it fits."""
    is_certain = evidence.edge_rms <= CERTAIN_EDGE_RMS
    is_certain &= evidence.log_exactness <= CERTAIN_LOG_EXACTNESS
    return HIDDEN_SHARE if is_certain and evidence.has_faces else ACCEPTED_SHARE


def may_be_another_size(evidence: Evidence) -> bool:
    """Return whether so many edges are missing that other dimensions must be tested."""
    return evidence.explained < COMPLETE_SHARE and evidence.has_faces


def _log_moved(moved: MovedFace) -> float:
    """Return the log-likelihood ratio of the solid with the moved face to the model."""
    return log_likelihood_of_found(moved.gained_px)
