"""Judge poses one after the other, the likeliest first.

What an object explains is no evidence for the next: its edge points are taken away from all others.
What an accepted object hides is no evidence against the others.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..modeling import CalibrationUncertainty
from .candidates import Candidate, Prepared, measured_candidates
from .chance import Chance, ChancePoses, chance_of, chance_poses
from .corrected_views import corrected_views
from .distinct_poses import in_one_place, pose_distances
from .evidence import Evidence
from .localization import Localization, Rival
from .moved_faces import likeliest_moved_face
from .pose_convergence import lengths_of_poses
from .pose_equations import UndeterminedPoseError
from .refinement import refine_pose
from .scene import Scene
from .verdict import MIN_MARGIN, REJECTED_SHARE, judge, may_be_another_size, relative_std

MAX_JUDGED = 12
"""Largest number of poses that are judged, all models together."""

CLOSE_RIVAL = 30.0
"""Log-likelihood below that of the best rival within which others are measured with all samples."""


def judged(
    scene: Scene,
    prepared: Sequence[Prepared],
    candidates: Sequence[Candidate],
    uncertainty: CalibrationUncertainty,
    tested: int,
) -> list[Localization]:
    """Return the verdicts on candidates, one after the other, the likeliest first.

    Of a model of which there is one already, candidates that are rejected anyway are left out.

    Args:
        scene: edge points of the pictures; what is found is taken away from them.
        prepared: the models.
        candidates: the likeliest first.
        uncertainty: of the calibration in these views.
        tested: number of poses that were looked at.
    """
    judging = _Judging(scene, prepared, uncertainty, tested)
    found = judging.in_order(candidates, [])
    accepted = [one for one in found if one.accepted]
    # What was judged before its neighbours were known is judged again, with what these hide.
    if not accepted or all(one.accepted for one in found[: len(accepted)]):
        return found
    anew = scene.untouched()
    judging = _Judging(anew, prepared, uncertainty, tested)
    for one in accepted:
        judging.take(one)
    return judging.in_order(measured_candidates(anew, prepared, candidates), accepted)


class _Judging:
    """The verdicts on poses in a scene; chance is measured once for each model and each taking."""

    def __init__(
        self,
        scene: Scene,
        prepared: Sequence[Prepared],
        uncertainty: CalibrationUncertainty,
        tested: int,
    ):
        self.scene, self._prepared = scene, prepared
        self._uncertainty, self._tested = uncertainty, tested
        self._tried: dict[int, ChancePoses] = {}
        self._tried_before: dict[int, ChancePoses] = {}

    def in_order(
        self, candidates: Sequence[Candidate], known: Sequence[Localization]
    ) -> list[Localization]:
        """Return what is known, and the verdicts on candidates at other places, in their order."""
        found, waiting = list(known), list(candidates)
        for one in known:
            waiting = self._elsewhere(one, waiting)
        count = 0
        while waiting and count < MAX_JUDGED:
            best, waiting = waiting[0], waiting[1:]
            # The order is that of likelihood, which counts length too: one that follows may explain
            # a larger share of itself.
            if found and best.explained < REJECTED_SHARE:
                continue
            count += 1
            is_known = any(one.model_index == best.model for one in found)
            if is_known and self.is_rejected_unrefined(best):
                continue
            one = self.best_explanation(best, waiting)
            if one is None:
                continue
            found.append(one)
            if one.accepted:
                waiting = self._elsewhere(one, waiting)
            if waiting and one.verdict.decision != "rejected":
                # What is explained already is no evidence: the others are looked at anew.
                self.take(one)
                waiting = measured_candidates(self.scene, self._prepared, waiting)
        return found

    def _elsewhere(self, one: Localization, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return the candidates that are not where an object is."""
        # Two solids are not in one place.
        own, pose = self._prepared[one.model_index].model, one.world_from_object
        return [
            c
            for c in candidates
            if not in_one_place(own, pose, self._prepared[c.model].model, c.pose)
        ]

    def take(self, one: Localization) -> None:
        """Take the edge points that an object explains, and what an accepted one hides."""
        wireframe = self._prepared[one.model_index].coarse if one.accepted else None
        claim = self.scene.claim(one.refined.lines, wireframe, one.world_from_object)
        self.scene.take(claim)
        # Kept: the places that were tried can be measured again without a search.
        self._tried_before |= self._tried
        self._tried.clear()

    def _chance(self, candidate: Candidate) -> Chance:
        """Return how much of a model other places explain."""
        one, index = self._prepared[candidate.model], candidate.model
        if index not in self._tried:
            self._tried[index] = chance_poses(
                candidate.pose, one.model, one.coarse, self.scene.views, self.scene.lookup
            )
        return chance_of(candidate.pose, one.model, self._tried[index])

    def is_rejected_unrefined(self, candidate: Candidate) -> bool:
        """Return whether a pose is rejected as it is, whatever its rivals."""
        one, scene = self._prepared[candidate.model], self.scene
        before = self._tried_before.get(candidate.model)
        if before is not None and candidate.model not in self._tried:
            # Drawn to what has been taken since, they explain less than if they were drawn anew:
            # what such a chance rejects is rejected.
            poses = before.world_from_object
            lengths = lengths_of_poses(one.coarse, scene.views, scene.lookup, poses)
            least = chance_of(candidate.pose, one.model, ChancePoses(poses, lengths))
            if self._is_rejected_by(candidate, least):
                return True
        return self._is_rejected_by(candidate, self._chance(candidate))

    def _is_rejected_by(self, candidate: Candidate, chance: Chance) -> bool:
        """Return whether a pose is rejected, given what other places explain."""
        one, pose = self._prepared[candidate.model], candidate.pose
        lines = self.scene.lines(pose, one.coarse)
        evidence = self.scene.evidence(lines, one.coarse, one.middle_at(pose), chance.mean)
        return judge(evidence, chance, self._tested, np.inf).decision == "rejected"

    def best_explanation(
        self, first: Candidate, others: Sequence[Candidate]
    ) -> Localization | None:
        """Return the verdict on a candidate, or on its best rival where that is clearly better.

        Candidates are ordered by how much they explain, with few samples and before they are
        fitted, so that a model a little too large may come before the true one.
        None if too few edges determine the candidate's pose.
        """
        one = self.localization(first, others)
        if one is None or one.verdict.margin > -MIN_MARGIN:
            return one
        rival = one.rivals[0]
        pose = Candidate(rival.model, rival.world_from_object, 0.0, 0.0)
        (second,) = measured_candidates(self.scene, self._prepared, [pose])
        better = self.localization(second, [first, *others])
        is_better = better is not None and better.verdict.margin > one.verdict.margin
        return better if is_better else one

    def localization(self, best: Candidate, others: Sequence[Candidate]) -> Localization | None:
        """Return the verdict on a candidate; None if too few edges determine its pose."""
        one, scene = self._prepared[best.model], self.scene
        try:
            refined = refine_pose(
                best.pose, one.model, one.fine, scene.views, scene.lookup, self._uncertainty
            )
        # Too few edges are left once others have been taken: there is nothing to report.
        except UndeterminedPoseError:
            return None
        pose, chance = refined.world_from_object, self._chance(best)
        lines, middle = scene.lines(pose, one.fine), one.middle_at(pose)
        evidence = scene.evidence(lines, one.fine, middle, chance.mean)
        rivals = self._rivals(best, pose, others, chance)
        rivals = self._distinct(best, pose, evidence, chance, rivals)
        margin = evidence.log_odds - rivals[0].log_odds if rivals else np.inf
        name = ""
        if rivals:
            k = rivals[0].model
            other = repr(self._prepared[k].model.name) if self._prepared[k].model.name else str(k)
            name = "another pose" if k == best.model else f"the model {other}"
        views = scene.views
        # Rivals are not corrected, and are compared with what is not corrected either.
        if len(refined.calibration_error):
            views = corrected_views(views, self._uncertainty, refined.calibration_error)
            lines = scene.lines(pose, one.fine, views)
            evidence = scene.evidence(lines, one.fine, middle, chance.mean, refined.absorbed)
        uncertain = relative_std(one.model, refined.covariance)
        verdict = judge(evidence, chance, self._tested, margin, name, uncertain)
        # Moving faces takes time, so that only what would be accepted is asked.
        if verdict.decision == "accepted" and may_be_another_size(evidence):
            moved = likeliest_moved_face(pose, one.model, lines, views, scene.lookup)
            evidence = evidence._replace(moved=moved)
            verdict = judge(evidence, chance, self._tested, margin, name, uncertain)
        return Localization(one.model, best.model, refined, verdict, tuple(rivals))

    def _rivals(
        self,
        best: Candidate,
        pose: Float[np.ndarray, "4 4"],
        others: Sequence[Candidate],
        chance: Chance,
    ) -> list[Rival]:
        """Return the other explanations of what is at one place."""
        one = self._prepared[best.model]
        there = [
            c
            for c in others
            if in_one_place(one.model, pose, self._prepared[c.model].model, c.pose)
        ]
        there = [
            c
            for c in there
            if c.model != best.model or pose_distances(one.model, pose, c.pose[None])[0] >= one.same
        ]
        likelihoods = [c.log_likelihood(chance.mean) for c in there]
        rivals = []
        for other, likelihood in zip(there, likelihoods, strict=True):
            # The verdict rests on the best ones: few samples would not do for their difference.
            if likelihood > max(likelihoods) - CLOSE_RIVAL:
                rivals.append(self._as_rival(other.model, other.pose, chance))
            else:
                rivals.append(Rival(other.model, other.pose, likelihood))
        return rivals

    def _as_rival(self, model: int, pose: Float[np.ndarray, "4 4"], chance: Chance) -> Rival:
        """Return a pose as a rival, measured with all samples."""
        one = self._prepared[model]
        lines = self.scene.lines(pose, one.fine)
        found = self.scene.evidence(lines, one.fine, one.middle_at(pose), chance.mean)
        return Rival(model, pose, found.log_likelihood, found.log_exactness)

    def _distinct(
        self,
        best: Candidate,
        pose: Float[np.ndarray, "4 4"],
        own: Evidence,
        chance: Chance,
        rivals: Sequence[Rival],
    ) -> list[Rival]:
        """Return the rivals that stay others when those that decide are fitted, the best first.

        Few samples and a wide search leave a pose short of the one to which its edges draw it: some
        rivals are but the pose itself, not yet drawn there.

        Args:
            best, pose: what is judged, and its fitted pose.
            own: evidence of that pose.
            chance: that it was computed with.
            rivals: in any order.
        """
        one, kept = self._prepared[best.model], list[Rival]()
        for rival in sorted(rivals, key=lambda rival: -rival.log_odds):
            # Before its fit a rival is less exact than it can be.
            is_close = own.log_likelihood - rival.log_likelihood < MIN_MARGIN
            is_close |= own.log_odds - rival.log_odds < MIN_MARGIN
            if not is_close:
                kept.append(rival)
                continue
            fitted = self._fitted(rival, chance)
            if rival.model != best.model:
                kept.append(fitted)
                continue
            # Neither the pose itself nor a rival that another one was drawn to.
            known = [pose, *(r.world_from_object for r in kept if r.model == best.model)]
            apart = pose_distances(one.model, fitted.world_from_object, np.stack(known))
            if apart.min() >= one.same:
                kept.append(fitted)
        return sorted(kept, key=lambda rival: -rival.log_odds)

    def _fitted(self, rival: Rival, chance: Chance) -> Rival:
        """Return a rival at its fitted pose; as it is where that explains less, or is none."""
        one, scene = self._prepared[rival.model], self.scene
        try:
            refined = refine_pose(
                rival.world_from_object,
                one.model,
                one.fine,
                scene.views,
                scene.lookup,
                self._uncertainty,
            )
        except UndeterminedPoseError:
            return rival
        fitted = self._as_rival(rival.model, refined.world_from_object, chance)
        # A fit that leaves edges out says nothing against the pose that has them.
        return rival if fitted.log_odds < rival.log_odds else fitted
