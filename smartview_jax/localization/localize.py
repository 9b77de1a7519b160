"""Find known objects in calibrated pictures, and say how certain each is.

Hypotheses are drawn to the pictures' edges, ranked by the visible edge length that they explain,
and judged one after the other: what an object explains is no evidence for the next.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..engine import Noise
from ..evaluation import CalibrationEstimate
from ..features import PictureEvidence, picture_evidence
from ..modeling import CalibrationUncertainty, ObjectModel, SeenViews
from ..robots import Command, CommandLike
from .distinct_poses import pose_distances
from .edge_lines import EdgeLines, poses_on_edges
from .edge_lookup import EdgeLookup
from .hypotheses import Hypothesis, find_hypotheses
from .localization import Localization, Localizations, Rival
from .refinement import FIT_SAMPLES, explained_edge_points, refine_pose
from .verdict import REJECTED_SHARE, Chance, Evidence, chance_of, evidence_of, judge, relative_std
from .wireframe import EDGE_SAMPLES, Wireframe

MAX_HYPOTHESES = 24
"""Largest number of hypotheses of each model that are drawn to the pictures' edges."""

MAX_JUDGED = 12
"""Largest number of poses that are judged, all models together."""

SAME_POSE = 0.04
"""Largest RMS distance between the vertices of poses that count as one, over the model's extent."""

SAME_PLACE = 0.5
"""Distance between the middles of two objects, over the smaller extent, that cannot both be there.
"""

TYPICAL_CHANCE = 0.25
"""Share of an edge that clutter explains, by which poses are ranked before it is measured."""


class _Candidate(NamedTuple):
    """A pose that was drawn to the edges of the pictures."""

    model: int
    pose: Float[np.ndarray, "4 4"]
    evidence: Evidence


class _Prepared(NamedTuple):
    """A model with its wireframes, of few samples and of many."""

    model: ObjectModel
    coarse: Wireframe
    fine: Wireframe

    @property
    def extent(self) -> float:
        """The largest size of the model along an axis, m."""
        return float(np.ptp(self.model.vertices, axis=0).max())

    @property
    def same(self) -> float:
        """The distance between the vertices of poses that count as one, m."""
        return SAME_POSE * self.extent


class _Scene:
    """The pictures of one scene, and which of their edge points no object explains yet."""

    def __init__(self, views: SeenViews, pictures: Sequence[PictureEvidence]):
        self.views = views
        self._points = [one.edge_points for one in pictures]
        self._free = [np.ones(len(points.pixels), dtype=bool) for points in self._points]
        self.strengths = [points.strengths for points in self._points]
        self.lookup = self._lookup()

    def _lookup(self) -> EdgeLookup:
        return EdgeLookup.of(self._points, self.views.camera.image_size, self._free)

    def take(self, lines: EdgeLines) -> None:
        """Take edge points that an object explains away from all others."""
        for view, (free, points) in enumerate(zip(self._free, self._points, strict=True)):
            free[explained_edge_points(lines, view, points)] = False
        self.lookup = self._lookup()


def localize(
    pictures_or_features: Sequence[np.ndarray | PictureEvidence],
    poses: CommandLike,
    calibration: Calibration,
    models: ObjectModel | Sequence[ObjectModel],
    *,
    covariance: CalibrationEstimate | None = None,
    noise: Noise | None = None,
    previous: Localizations | None = None,
    hypotheses: Sequence[Hypothesis] | None = None,
    workspace: Float[np.ndarray, "2 3"] | None = None,
) -> Localizations:
    """Find objects of known models in one, two or more calibrated pictures.

    Args:
        pictures_or_features: uint8 pictures, or what `picture_evidence` found in them; one a view.
        poses: what the robot reported in each view, `base_from_tool`.
        calibration: the calibrated camera; poses of objects are in its world frame.
        models: of the objects that may be there, any number of each.
        covariance: a joint fit, or a bound, that states how well the calibration is known; None
            takes it as exact.
        noise: sizes of the robot's noise in these views; by default that of the fit.
        previous: what was found in earlier views of the same scene. Their pictures count together
            with the new ones, and every hypothesis is judged anew.
        hypotheses: poses to begin from instead of those that are searched for.
        workspace: two opposite corners of a box in the world, m, in which objects are, as of a bin;
            what is not there is not found. None for anywhere.

    Returns:
        What was found, accepted ones first; `messages` says why the others were not.

    Raises:
        ValueError: no views, a number of poses that is not that of the pictures, a model without
            edges, or a picture on which nothing can be found; the message names the view or model.
    """
    prepared = _prepared(models)
    views = _checked_views(pictures_or_features, poses, calibration)
    pictures = tuple(
        _evidence(view, one, calibration) for view, one in enumerate(pictures_or_features)
    )
    if previous is not None:
        command = _joined_commands(previous.command, _own_command(views))
        pictures = (*previous.pictures, *pictures)
        views = SeenViews.of(calibration, command)
    uncertainty = CalibrationUncertainty.of(views, calibration, covariance, noise)
    if hypotheses is None and previous is not None and len(previous):
        hypotheses = _hypotheses_of(previous)
    if hypotheses is None:
        hypotheses = find_hypotheses(
            pictures, views, [one.model for one in prepared], workspace=workspace
        )
    scene = _Scene(views, pictures)
    candidates = _converged(scene, prepared, hypotheses)
    if workspace is not None:
        low, high = np.min(workspace, axis=0), np.max(workspace, axis=0)
        middles = [_middle(prepared[one.model], one.pose) for one in candidates]
        inside = [bool(((low <= m) & (m <= high)).all()) for m in middles]
        candidates = [one for one, is_in in zip(candidates, inside, strict=True) if is_in]
    found = _judged(scene, prepared, candidates, uncertainty, len(hypotheses))
    return Localizations(
        _reported(found), _messages(prepared, found, hypotheses), pictures, _own_command(views)
    )


def _prepared(models: ObjectModel | Sequence[ObjectModel]) -> list[_Prepared]:
    """Return models with their wireframes."""
    given = [models] if isinstance(models, ObjectModel) else list(models)
    if not given:
        raise ValueError("models: expected at least one, found none")
    for k, one in enumerate(given):
        if not len(one.edges):
            raise ValueError(f"models: model {k} {one.name!r} has no edges, nothing to look for")
    return [
        _Prepared(one, Wireframe.of(one, EDGE_SAMPLES), Wireframe.of(one, FIT_SAMPLES))
        for one in given
    ]


def _checked_views(
    pictures: Sequence[np.ndarray | PictureEvidence], poses: CommandLike, calibration: Calibration
) -> SeenViews:
    """Return the views, after checking that each picture has a pose."""
    if isinstance(pictures, np.ndarray | PictureEvidence) or not len(pictures):
        raise ValueError("pictures: expected a list of pictures, one for each view")
    views = SeenViews.of(calibration, poses)
    count = len(views.camera_from_world)
    if count != len(pictures):
        raise ValueError(
            f"poses: {len(pictures)} pictures and {count} poses; view {min(count, len(pictures))} "
            "has only one of them, so it is not calibrated"
        )
    return views


def _evidence(
    view: int, picture: np.ndarray | PictureEvidence, calibration: Calibration
) -> PictureEvidence:
    """Return what is found in the picture of a view."""
    if isinstance(picture, PictureEvidence):
        return picture
    try:
        return picture_evidence(picture, calibration.camera)
    except ValueError as error:
        raise ValueError(f"view {view}: {error}") from None


def _own_command(views: SeenViews) -> Command:
    """Return what the robot reported in the views, without padding, on the host."""
    count = len(views.camera_from_world)
    return jax.tree.map(lambda x: np.asarray(x)[:count], views.command)


def _joined_commands(first: Command, second: Command) -> Command:
    """Return two batches of commands as one."""
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)


def _hypotheses_of(previous: Localizations) -> list[Hypothesis]:
    """Return every pose that earlier views left, rivals included."""
    poses = [(one.model_index, one.world_from_object) for one in previous]
    poses += [(rival.model, rival.world_from_object) for one in previous for rival in one.rivals]
    return [Hypothesis(model, pose, 0.0, 0.0) for model, pose in poses]


def _converged(
    scene: _Scene, prepared: Sequence[_Prepared], hypotheses: Sequence[Hypothesis]
) -> list[_Candidate]:
    """Return hypotheses drawn to the edges of the pictures, each once, the likeliest first."""
    candidates = []
    for index, one in enumerate(prepared):
        starts = [h.world_from_object for h in hypotheses if h.model == index][:MAX_HYPOTHESES]
        if not starts:
            continue
        found, shares = poses_on_edges(one.coarse, scene.views, scene.lookup, np.stack(starts))
        kept: list[np.ndarray] = []
        for pose in found[np.argsort(-shares)]:
            if not kept or pose_distances(one.model, pose, np.stack(kept)).min() > one.same:
                kept.append(pose)
                candidates.append(_Candidate(index, pose, _evidence_at(scene, one, pose)))
    return sorted(candidates, key=lambda one: -one.evidence.log_likelihood)


def _evidence_at(
    scene: _Scene,
    one: _Prepared,
    pose: Float[np.ndarray, "4 4"],
    chance: float = TYPICAL_CHANCE,
    wireframe: Wireframe | None = None,
) -> Evidence:
    """Return what the free edge points of the pictures say of a pose."""
    used = one.coarse if wireframe is None else wireframe
    return evidence_of(pose, used, scene.views, scene.lookup, scene.strengths, chance)


def _middle(one: _Prepared, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    """Return the middle of a model's vertices in the world, m."""
    return pose[:3, :3] @ one.model.vertices.mean(axis=0) + pose[:3, 3]


def _overlap(
    one: _Prepared,
    pose: Float[np.ndarray, "4 4"],
    other: _Prepared,
    its_pose: Float[np.ndarray, "4 4"],
) -> bool:
    """Return whether two objects would be in one place."""
    apart = np.linalg.norm(_middle(one, pose) - _middle(other, its_pose))
    return bool(apart < SAME_PLACE * min(one.extent, other.extent))


def _judged(
    scene: _Scene,
    prepared: Sequence[_Prepared],
    candidates: list[_Candidate],
    uncertainty: CalibrationUncertainty,
    tested: int,
) -> list[Localization]:
    """Return the verdicts on candidates, one after the other, the likeliest first."""
    found: list[Localization] = []
    waiting = list(candidates)
    for _ in range(MAX_JUDGED):
        # What is explained already is no evidence: the others are looked at anew.
        waiting = [
            c._replace(evidence=_evidence_at(scene, prepared[c.model], c.pose)) for c in waiting
        ]
        waiting.sort(key=lambda one: -one.evidence.log_likelihood)
        if not waiting:
            break
        best, waiting = waiting[0], waiting[1:]
        if found and best.evidence.explained < REJECTED_SHARE:
            break
        one = _judge_candidate(scene, prepared, best, waiting, uncertainty, tested)
        if one is None:
            continue
        found.append(one)
        if one.verdict.decision != "rejected":
            scene.take(one.refined.lines)
        if one.accepted:
            # Two solids are not in one place.
            own, pose = prepared[best.model], one.world_from_object
            waiting = [c for c in waiting if not _overlap(own, pose, prepared[c.model], c.pose)]
    return found


def _judge_candidate(
    scene: _Scene,
    prepared: Sequence[_Prepared],
    best: _Candidate,
    others: Sequence[_Candidate],
    uncertainty: CalibrationUncertainty,
    tested: int,
) -> Localization | None:
    """Return the verdict on a candidate; None if too few edges determine its pose."""
    one = prepared[best.model]
    try:
        refined = refine_pose(
            best.pose, one.model, one.fine, scene.views, scene.lookup, uncertainty
        )
    except ValueError:
        return None
    pose = refined.world_from_object
    chance = chance_of(pose, one.model, one.coarse, scene.views, scene.lookup)
    evidence = _evidence_at(scene, one, pose, chance.mean, one.fine)
    rivals = _rivals(scene, prepared, best, pose, others, chance)
    margin = evidence.log_likelihood - rivals[0].log_likelihood if rivals else np.inf
    name = ""
    if rivals:
        other = prepared[rivals[0].model].model.name
        name = "another pose" if rivals[0].model == best.model else f"the model {other!r}"
    uncertain = relative_std(one.model, refined.covariance)
    verdict = judge(evidence, chance, tested, margin, name, uncertain)
    return Localization(one.model, best.model, refined, verdict, tuple(rivals))


def _rivals(
    scene: _Scene,
    prepared: Sequence[_Prepared],
    best: _Candidate,
    pose: Float[np.ndarray, "4 4"],
    others: Sequence[_Candidate],
    chance: Chance,
) -> list[Rival]:
    """Return the other explanations of what is at one place, the best first."""
    one, rivals = prepared[best.model], []
    for other in others:
        its = prepared[other.model]
        if not _overlap(one, pose, its, other.pose):
            continue
        same_model = other.model == best.model
        if same_model and pose_distances(one.model, pose, other.pose[None])[0] < one.same:
            continue
        evidence = _evidence_at(scene, its, other.pose, chance.mean, its.fine)
        rivals.append(Rival(other.model, other.pose, evidence.log_likelihood))
    return sorted(rivals, key=lambda rival: -rival.log_likelihood)


def _reported(found: Sequence[Localization]) -> list[Localization]:
    """Return accepted and open ones, and the best rejected one of each model without any."""
    order = {"accepted": 0, "open": 1, "rejected": 2}
    kept = [one for one in found if one.verdict.decision != "rejected"]
    for one in found:
        if one.model_index not in {other.model_index for other in kept}:
            kept.append(one)
    return sorted(kept, key=lambda one: order[one.verdict.decision])


def _messages(
    prepared: Sequence[_Prepared],
    found: Sequence[Localization],
    hypotheses: Sequence[Hypothesis],
) -> tuple[str, ...]:
    """Return, for every model that was not accepted, why."""
    messages = []
    for index, one in enumerate(prepared):
        own = [each for each in found if each.model_index == index]
        if any(each.accepted for each in own):
            continue
        name = one.model.name or f"model {index}"
        undecided = [each for each in own if each.verdict.decision == "open"]
        if undecided:
            messages += [each.message for each in undecided]
        elif own:
            messages.append(f"{name}: not found: {'; '.join(own[0].verdict.reasons)}")
        else:
            tried = sum(h.model == index for h in hypotheses)
            messages.append(f"{name}: not found: {tried} hypotheses, none with enough edges")
    return tuple(messages)
