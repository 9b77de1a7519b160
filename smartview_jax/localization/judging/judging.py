"""Judge poses one after the other, the likeliest first.

Edge points that one object explains are no evidence for the next: they are removed. Edges that an
accepted object hides do not count as missing in the others.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..distinct_poses import pose_distances, surface_sigma
from ..edges import EdgeLines, Wireframe
from ..refining import RefinedPose, UndeterminedPoseError, refine_pose
from ..solid_overlap import TOLERATED_SIGMAS, in_one_place, middles_are_near, overlap_tolerance
from .candidates import Candidate, Prepared, Query, measured_candidates
from .cast_shadows import log_odds_to_shadow
from .evidence import Evidence, are_one_direction, evidence_of
from .localization import Localization, Rival
from .moved_faces import likeliest_moved_face
from .scene import Scene, explained_among
from .verdict import Verdict, judge, may_be_another_size, relative_std

MAX_REJECTED = 12
"""Number of poses in a row without an accepted one, all models together, after which no further
poses are judged."""

CLOSE_RIVAL = 30.0
"""Rivals within this log-likelihood of the best rival are measured with all samples."""


class Judgement(NamedTuple):
    """The verdicts on candidates, and the candidates that were not judged.

    Attributes:
        results: verdicts, known objects first.
        unjudged: candidates that might be objects, after `MAX_REJECTED` that are not.
    """

    results: list[Localization]
    unjudged: list[Candidate]


def judged(
    scene: Scene,
    query: Query,
    candidates: Sequence[Candidate],
    tested: int,
    known: Sequence[Localization] = (),
) -> Judgement:
    """Return the verdicts on candidates, one after the other, the likeliest first.

    Once an object of a model is found, its further candidates that would be rejected anyway are
    left out.

    Args:
        scene: edge points of the pictures that the known objects leave, from which found objects
            take theirs.
        query: what is looked for.
        candidates: the likeliest first.
        tested: number of poses that were examined.
        known: objects that were accepted before.
    """
    judging = _Judging(scene, query, tested)
    judgement = judging.in_order(candidates, known)
    accepted = [obj for obj in judgement.results if obj.accepted]
    # Poses judged before their neighbours were known are judged again, with the neighbours as
    # occluders.
    if not accepted or all(obj.accepted for obj in judgement.results[: len(accepted)]):
        return judgement
    free = scene_without(scene, query.models, accepted)
    judging = _Judging(free, query, tested)
    return judging.in_order(_remeasured(free, query, candidates), accepted)


def _remeasured(scene: Scene, query: Query, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return candidates measured again on the edge points that are free now."""
    return measured_candidates(scene, query, [(c.model, c.pose) for c in candidates])


def scene_without(
    scene: Scene, prepared: Sequence[Prepared], objects: Sequence[Localization]
) -> Scene:
    """Return the scene without the edge points of objects; accepted ones occlude the others."""
    free = scene.untouched()
    for obj in objects:
        _take(free, prepared, obj)
    return free


def _take(scene: Scene, prepared: Sequence[Prepared], obj: Localization) -> None:
    """Take away the edge points that an object explains; an accepted one then occludes."""
    wireframe = prepared[obj.model_index].coarse if obj.accepted else None
    scene.take(scene.claim(obj.refined.lines, wireframe, obj.world_from_object))


class _Judging:
    """The verdicts on poses in a scene."""

    def __init__(self, scene: Scene, query: Query, tested: int):
        self.scene, self._query, self._tested = scene, query, tested
        self._prepared, self._uncertainty = query.models, query.uncertainty
        self._options, self._disagreement = query.options, query.disagreement
        self._accepted: list[Localization] = []

    def in_order(self, candidates: Sequence[Candidate], known: Sequence[Localization]) -> Judgement:
        """Return the known objects and the verdicts on candidates at other places, in order."""
        results, waiting = list(known), list(candidates)
        self._accepted = [obj for obj in known if obj.accepted]
        for obj in known:
            waiting = self._elsewhere(obj, waiting)
        count = 0
        while waiting and count < MAX_REJECTED:
            best, waiting = waiting[0], waiting[1:]
            # The order is by likelihood, which grows with length: a later candidate may explain a
            # larger share.
            if results and best.explained < self._options.rejected_share:
                continue
            count += 1
            is_known = any(obj.model_index == best.model for obj in results)
            if is_known and self.is_rejected_unrefined(best):
                continue
            obj = self.best_explanation(best, waiting)
            if obj is None:
                continue
            results.append(obj)
            if obj.accepted:
                self._accepted.append(obj)
                count, waiting = 0, self._elsewhere(obj, waiting)
            if waiting and obj.verdict.decision != "rejected":
                # Its edge points are no evidence for the others, which are measured again without
                # them.
                _take(self.scene, self._prepared, obj)
                waiting = _remeasured(self.scene, self._query, waiting)
        unjudged = [c for c in waiting if c.explained >= self._options.rejected_share]
        return Judgement(results, unjudged)

    def _elsewhere(self, obj: Localization, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return the candidates that do not overlap with an object."""
        return [c for c in candidates if not self._overlap(obj.model_index, obj.refined, c)]

    def _overlap(self, model: int, refined: RefinedPose, candidate: Candidate) -> bool:
        """Return whether an object at its refined pose and a candidate occupy the same space."""
        entry, other = self._prepared[model], self._prepared[candidate.model]
        # A candidate stands for all poses that count as the same.
        sigma = surface_sigma(entry.model, refined.covariance)
        tolerance = overlap_tolerance(sigma) + other.same
        pose = refined.world_from_object
        return in_one_place(entry.model, pose, other.model, candidate.pose, tolerance)

    def is_rejected_unrefined(self, candidate: Candidate) -> bool:
        """Return whether a pose is rejected without refinement, whatever its rivals."""
        entry, pose = self._prepared[candidate.model], candidate.pose
        lines = self.scene.lines(pose, entry.coarse)
        evidence = self._evidence(lines, entry, pose, entry.coarse)
        verdict = judge(evidence, self._tested, np.inf, options=self._options)
        return verdict.decision == "rejected"

    def best_explanation(
        self, first: Candidate, others: Sequence[Candidate]
    ) -> Localization | None:
        """Return the verdict on a candidate, or on its best rival where that is clearly better.

        Candidates are ordered by how much they explain, with few samples and before they are
        fitted, so that a model that is slightly too large may come before the true one.
        None if too few edges determine the candidate's pose.
        """
        result = self.localization(first, others)
        if result is None or result.verdict.margin > -self._options.min_margin:
            return result
        rival = result.rivals[0]
        pose = rival.model, rival.world_from_object
        (second,) = measured_candidates(self.scene, self._query, [pose])
        better = self.localization(second, [first, *others])
        is_better = better is not None and better.verdict.margin > result.verdict.margin
        return better if is_better else result

    def localization(self, best: Candidate, others: Sequence[Candidate]) -> Localization | None:
        """Return the verdict on a candidate; None if too few edges determine its pose."""
        entry, scene = self._prepared[best.model], self.scene
        refined = self._refined(best.model, best.pose)
        # Too few edges are left after others were taken away: there is nothing to report.
        if refined is None:
            return None
        pose = refined.world_from_object
        lines = scene.lines(pose, entry.fine)
        evidence = self._evidence(lines, entry, pose, entry.fine)
        rivals = self._rivals(best, refined, others)
        rivals = self._distinct(best, pose, evidence, rivals)
        margin = evidence.log_odds - rivals[0].log_odds if rivals else np.inf
        name = self._words_for(rivals[0], best) if rivals else ""
        views = scene.views
        # Rivals are not corrected, so the margin above compares uncorrected evidence.
        if len(refined.calibration_error):
            views = self._uncertainty.corrected(views, refined.calibration_error)
            lines = scene.lines(pose, entry.fine, views)
            evidence = self._evidence(lines, entry, pose, entry.fine, refined.absorbed)
        uncertain = relative_std(entry.model, refined.covariance)

        def verdict_on(evidence: Evidence) -> Verdict:
            with_rig = evidence._replace(disagreement=self._disagreement)
            return judge(with_rig, self._tested, margin, name, uncertain, self._options)

        verdict = verdict_on(evidence)
        if verdict.decision != "rejected":
            odds = self._shadow_odds(best.model, refined, lines)
            evidence = evidence._replace(shadow_odds=odds)
            verdict = verdict_on(evidence)
        # Moving faces takes time: only poses that would be accepted are tested.
        if verdict.decision == "accepted" and may_be_another_size(evidence, self._options):
            moved = likeliest_moved_face(pose, entry.model, lines, views, scene.lookup)
            # Within its tolerance the object has the model's dimensions.
            least = TOLERATED_SIGMAS * float(entry.fine.tolerance)
            if moved.face is None or abs(moved.distance) >= least:
                verdict = verdict_on(evidence._replace(moved=moved))
        scale = scene.pictures[0].scale
        return Localization(entry.model, best.model, refined, verdict, tuple(rivals), scale)

    def _refined(self, model: int, pose: Float[np.ndarray, "4 4"]) -> RefinedPose | None:
        """Return the refined pose of a model; None if too few edges determine it."""
        entry, scene = self._prepared[model], self.scene
        try:
            return refine_pose(
                pose, entry.model, entry.fine, scene.views, scene.lookup, self._uncertainty
            )
        except UndeterminedPoseError:
            return None

    def _words_for(self, rival: Rival, best: Candidate) -> str:
        """Return the name of a candidate's rival in messages."""
        if rival.model == best.model:
            return "another pose"
        name = self._prepared[rival.model].model.name
        return f"the model {name!r}" if name else f"the model {rival.model}"

    def _evidence(
        self,
        lines: EdgeLines,
        entry: Prepared,
        pose: Float[np.ndarray, "4 4"],
        wireframe: Wireframe,
        absorbed: float = 0.0,
    ) -> Evidence:
        """Return the evidence of the edges of a model's wireframe that were measured at a pose."""
        poses = self.scene.views.camera_from_world
        is_alone = are_one_direction(poses, entry.middle_at(pose))
        return evidence_of(lines, wireframe, is_alone, absorbed, self._options)

    def _shadow_odds(self, model: int, refined: RefinedPose, lines: EdgeLines) -> float | None:
        """Return the log-odds of an object to the shadow of an equal one; None without any."""
        entry = self._prepared[model]
        equal = [obj.refined for obj in self._accepted if obj.model_index == model]
        sigmas = [surface_sigma(entry.model, each.covariance) for each in (refined, *equal)]
        return log_odds_to_shadow(
            lines,
            entry,
            self.scene.views,
            refined.world_from_object,
            [each.world_from_object for each in equal],
            overlap_tolerance(sigmas[0], max(sigmas[1:], default=0.0)),
            self._options,
        )

    def _rivals(
        self,
        best: Candidate,
        refined: RefinedPose,
        others: Sequence[Candidate],
    ) -> list[Rival]:
        """Return the other explanations of the edges at one place.

        Two poses cannot both be right if they overlap, or if without the edge points that one
        explains the other would be rejected.
        """
        entry, pose = self._prepared[best.model], refined.world_from_object
        free = self.scene.claim(refined.lines).free
        near = [
            c
            for c in others
            if self._overlap(best.model, refined, c) or self._needs_edges_of(best, pose, free, c)
        ]
        near = [
            c
            for c in near
            if c.model != best.model
            or pose_distances(entry.model, pose, c.pose[None])[0] >= entry.same
        ]
        likelihoods = [c.log_likelihood for c in near]
        rivals = []
        for other, likelihood in zip(near, likelihoods, strict=True):
            # The verdict rests on the best rivals: few samples are not enough for their
            # difference.
            if likelihood > max(likelihoods) - CLOSE_RIVAL:
                rivals.append(self._as_rival(other.model, other.pose))
            else:
                rivals.append(Rival(other.model, other.pose, likelihood))
        return rivals

    def _needs_edges_of(
        self,
        best: Candidate,
        pose: Float[np.ndarray, "4 4"],
        free_points: Sequence[Bool[np.ndarray, "_"]],
        candidate: Candidate,
    ) -> bool:
        """Return whether a candidate near an object would be rejected without its edge points.

        Args:
            best, pose: the object, and its refined pose.
            free_points: for each view, which edge points it does not explain.
            candidate: another pose.
        """
        model, other = self._prepared[best.model].model, self._prepared[candidate.model]
        if not middles_are_near(model, pose, other.model, candidate.pose):
            return False
        lines = self.scene.lines(candidate.pose, other.coarse)
        smallest = self._options.rejected_share * candidate.visible_px
        return explained_among(lines, free_points) < smallest

    def _as_rival(self, model: int, pose: Float[np.ndarray, "4 4"]) -> Rival:
        """Return a pose as a rival, measured with all samples."""
        entry = self._prepared[model]
        lines = self.scene.lines(pose, entry.fine)
        evidence = self._evidence(lines, entry, pose, entry.fine)
        return Rival(model, pose, evidence.log_likelihood, evidence.log_exactness)

    def _distinct(
        self,
        best: Candidate,
        pose: Float[np.ndarray, "4 4"],
        evidence: Evidence,
        rivals: Sequence[Rival],
    ) -> list[Rival]:
        """Return the rivals that remain distinct when the close ones are refined, the best first.

        Candidates may not have converged, with few samples and a wide search. Refine the close
        rivals; drop those that end at the same pose.

        Args:
            best, pose: the judged candidate, and its refined pose.
            evidence: of that pose.
            rivals: in any order.
        """
        entry, kept = self._prepared[best.model], list[Rival]()
        for rival in sorted(rivals, key=lambda rival: -rival.log_odds):
            # Before its refinement a rival fits less exactly than it could.
            is_close = evidence.log_likelihood - rival.log_likelihood < self._options.min_margin
            is_close |= evidence.log_odds - rival.log_odds < self._options.min_margin
            if not is_close:
                kept.append(rival)
                continue
            fitted = self._fitted(rival)
            if rival.model != best.model:
                kept.append(fitted)
                continue
            # Keep it unless it converged to the judged pose or to another rival.
            known = [pose, *(r.world_from_object for r in kept if r.model == best.model)]
            apart = pose_distances(entry.model, fitted.world_from_object, np.stack(known))
            if apart.min() >= entry.same:
                kept.append(fitted)
        return sorted(kept, key=lambda rival: -rival.log_odds)

    def _fitted(self, rival: Rival) -> Rival:
        """Return a rival at its refined pose; unchanged where that explains less or fails."""
        refined = self._refined(rival.model, rival.world_from_object)
        if refined is None:
            return rival
        fitted = self._as_rival(rival.model, refined.world_from_object)
        # A fit that leaves edges out is no evidence against the pose that has them.
        return rival if fitted.log_odds < rival.log_odds else fitted
