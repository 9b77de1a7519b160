"""Judge whether an object is at a pose: accepted, rejected or open, with the numbers.

A pose has to be likelier than what else may explain the edges:

- clutter, by the share of the visible edge length with an edge point within `EXPLAINED_DISTANCE`
  and with the edge's orientation, in all views together and in each, and by how exactly whole edges
  fit: the two give the expected number of poses that clutter explains as well, among all that were
  examined (an a-contrario test: Desolneux, Moisan and Morel, "Meaningful alignments", 2000);
- another solid: where edges are missing, the model with a moved face might explain more, because
  the object has other dimensions (`moved_faces`);
- another pose, or another model, at the same place that symmetry does not make equal, by the
  log-likelihood ratio including the exactness of the fit;
- the shadow of an equal object, by the same ratio of the edges that it does not have
  (`cast_shadows`).

The views have to agree about all objects (`rig_noise`), and the pose has to be precise.
`VerdictOptions` has the limits.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ...modeling import ObjectModel
from ..distinct_poses import surface_sigma
from ..rig_noise import ViewDisagreement
from .evidence import Evidence, log_likelihood_of_found
from .moved_faces import MovedFace
from .options import DEFAULT_OPTIONS, VerdictOptions


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
    options: VerdictOptions = DEFAULT_OPTIONS,
) -> Verdict:
    """Return the verdict on a pose.

    Args:
        evidence: of the pose.
        tested: number of poses that were examined.
        margin: log-likelihood ratio to the best rival; infinite without one.
        rival: name of the best rival, in messages.
        uncertainty: `relative_std` of the pose.
        options: the limits.
    """
    log_false_alarms = float(np.log10(max(tested, 1)) - evidence.log_odds / np.log(10.0))
    shadow_odds = np.inf if evidence.shadow_odds is None else evidence.shadow_odds
    differs = evidence.disagreement
    wrong_rig = () if differs is None or not _is_rig_wrong(differs, options) else (differs.message,)
    against = _contradictions(evidence, log_false_alarms, shadow_odds, options)
    if against:
        reasons = (*against, *wrong_rig)
        return Verdict("rejected", reasons, evidence, log_false_alarms, margin)
    doubts = [
        *_missing_edges(evidence, options),
        *_weaknesses(evidence, log_false_alarms, uncertainty, options),
        *wrong_rig,
    ]
    if margin < options.min_margin:
        doubts.append(f"ambiguous: {rival} matches the pictures almost as well")
    if shadow_odds < options.min_margin:
        doubts.append("ambiguous: it may be the shadow of an equal object")
    return Verdict(
        "open" if doubts else "accepted", tuple(doubts), evidence, log_false_alarms, margin
    )


def _contradictions(
    evidence: Evidence, log_false_alarms: float, shadow_odds: float, options: VerdictOptions
) -> list[str]:
    """Return the reasons to reject a pose; none if an object may be there."""
    reasons = []
    if evidence.explained < options.rejected_share:
        reasons.append(f"only {evidence.explained:.0%} of its visible edges match the pictures")
    is_clutter = evidence.log_likelihood < 0.0 or log_false_alarms > 0.0
    if is_clutter or evidence.edges < options.min_edges:
        reasons.append(f"background clutter matches as well: {_amount(evidence)}")
    if shadow_odds <= -options.min_margin:
        reasons.append("it is the shadow of an equal object: its other edges are missing")
    return reasons


def _missing_edges(evidence: Evidence, options: VerdictOptions) -> list[str]:
    """Return doubts about a pose because the pictures do not show enough of the object."""
    doubts: list[str] = []
    share = evidence.explained
    if share < _accepted_share(evidence, options):
        fit = f", and these fit to {evidence.edge_rms:.2f} px"
        more = fit if share >= options.hidden_share else ""
        doubts.append(f"only {share:.0%} of its visible edges match the pictures{more}")
    in_view = evidence.explained_in_view
    showing, needed = sum(np.isfinite(in_view)), min(options.min_good_views, len(in_view))
    if showing < needed:
        doubts.append(f"only {showing} of {len(in_view)} views show enough of it")
    if evidence.in_picture < options.min_in_picture:
        doubts.append(f"only {evidence.in_picture:.0%} of its vertices are within a picture")
    if evidence.in_front < options.min_in_front:
        doubts.append(f"{1.0 - evidence.in_front:.0%} of its edges are occluded by other objects")
    if sum(matched >= options.accepted_view_share for matched in in_view) < needed:
        doubts += [
            f"view {k}: {matched:.0%} of its visible edges match the picture"
            for k, matched in enumerate(in_view)
            if matched < options.accepted_view_share
        ]
    return doubts


def _weaknesses(
    evidence: Evidence, log_false_alarms: float, uncertainty: float, options: VerdictOptions
) -> list[str]:
    """Return doubts about a pose because its edges are few, far off or do not determine it."""
    doubts: list[str] = []
    rms = evidence.edge_rms
    if log_false_alarms > options.max_log_false_alarms:
        doubts.append(
            f"little evidence: {_amount(evidence)}; {10.0**log_false_alarms:.2g} poses as good as "
            "this are expected by chance"
        )
    largest_rms = options.alone_edge_rms if evidence.is_alone else options.max_edge_rms
    if rms > np.hypot(largest_rms, evidence.tolerance_px):
        more = ", too far for pictures from one direction" if evidence.is_alone else ""
        doubts.append(f"its edges are {rms:.2f} px (RMS) from the picture edges{more}")
    if uncertainty > options.max_relative_std:
        doubts.append(f"its pose is uncertain by {uncertainty:.0%} of its size")
    if evidence.moved is not None and _log_moved(evidence.moved, options) > options.max_log_moved:
        face, distance = evidence.moved.face, 1e3 * evidence.moved.distance
        # The distance is known to one step only.
        length = f"{abs(distance):.{0 if abs(distance) >= 1.0 else 1}f} mm"
        size, way = ("larger", "outward") if distance > 0.0 else ("smaller", "inward")
        doubts.append(
            f"the object seems {size} than the model: moving face {face} {way} by {length} matches "
            "more edges"
        )
    return doubts


def _is_rig_wrong(disagreement: ViewDisagreement, options: VerdictOptions) -> bool:
    """Return whether the camera poses are off by more than is stated and than is usual."""
    is_off = disagreement.as_stated < options.min_agreement
    return is_off and disagreement.is_unusual(options.tolerated_arms)


def _amount(evidence: Evidence) -> str:
    """Return in words how much of the object is seen, and how well it fits."""
    return (
        f"{evidence.edges} matched edges, {evidence.explained:.0%} of {evidence.visible_px:.0f} px "
        f"visible, off by {evidence.edge_rms:.2f} px"
    )


def _accepted_share(evidence: Evidence, options: VerdictOptions) -> float:
    """Return the explained share above which a pose may be accepted, given how well it fits."""
    is_certain = evidence.edge_rms <= np.hypot(options.certain_edge_rms, evidence.tolerance_px)
    is_certain &= evidence.log_exactness <= options.certain_log_exactness
    return options.hidden_share if is_certain and evidence.has_faces else options.accepted_share


def may_be_another_size(evidence: Evidence, options: VerdictOptions) -> bool:
    """Return whether so many edges are missing that other dimensions must be tested."""
    return evidence.explained < options.complete_share and evidence.has_faces


def _log_moved(moved: MovedFace, options: VerdictOptions) -> float:
    """Return the log-likelihood ratio of the solid with the moved face to the model."""
    return log_likelihood_of_found(moved.gained_px, options)
