"""Find the poses at which known objects may be in the pictures, without an initial pose.

Poses are proposed from corners and segments, scored on the edges of all pictures, reduced to
distinct ones, refined on the edges, and scored again. In a single picture the proposals come from
paths of corners, a small part of a large object: near the best of them, junctions far apart give
further proposals. Round parts have no corners; the ellipses of their rims, or of the outlines of
smooth parts, propose their poses.
Nothing is accepted here: every hypothesis is still to be fitted and judged.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...argument_checks import MAX_COORDINATE
from ...cameras import distinct_cameras, with_cameras
from ...features import IdealPlane, PictureEvidence, scaled_camera
from ...geometry import host_transformed
from ...modeling import ObjectModel, SeenViews
from ..distinct_poses import distinct_poses
from ..edges import Wireframe, is_round, is_smooth
from .corner_poses import (
    Junctions,
    PicturePaths,
    picture_paths,
    poses_from_paths,
    poses_from_triples,
)
from .ellipse_poses import (
    SeenEllipses,
    poses_from_circles,
    poses_from_outlines,
    seen_ellipses,
)
from .options import DEFAULT_SEARCH_OPTIONS, SearchOptions
from .polishing import NARROW_GATES, WIDE_GATES, polished_poses
from .scoring import SceneMaps, score_poses
from .stereo_edges import SpaceEdges, poses_from_edges, stereo_edges


class Hypothesis(NamedTuple):
    """A pose at which an object may be.

    Attributes:
        model: index of the model.
        world_from_object: the pose.
        score: edge length in all pictures that lies on picture edges of the same direction, nearer
            ones counting more, minus the length expected by chance, px.
        explained: share of the visible wireframe's length that lies on edges.
    """

    model: int
    world_from_object: Float[np.ndarray, "4 4"]
    score: float
    explained: float


def find_hypotheses(
    evidence: Sequence[PictureEvidence],
    views: SeenViews,
    models: Sequence[ObjectModel],
    count: int | None = None,
    *,
    workspace: Float[np.ndarray, "2 3"] | None = None,
    options: SearchOptions = DEFAULT_SEARCH_OPTIONS,
) -> list[Hypothesis]:
    """Return the poses at which objects may be, the best hypotheses first.

    Args:
        evidence: of each picture.
        views: the camera's poses at the pictures; one is enough, two or more determine far more.
        models: models of the objects that may be there. A known symmetry keeps equal poses from
            being listed several times.
        count: largest number of hypotheses of each model; by default as the options say.
        workspace: two opposite corners of a box in the world, m, that contains the objects; its
            lower side is then the table or the bottom of the bin. Vertices may be outside by
            `SearchOptions.workspace_slack`. None for anywhere.
        options: limits of the search.

    Raises:
        ValueError: no pictures or no models, numbers of pictures and poses that differ, a model
            without edges, or a workspace that is not a box.
    """
    if not len(models):
        raise ValueError("models: expected at least one, found none")
    box = None if workspace is None else checked_box(workspace)
    count = options.hypotheses if count is None else count
    evidence, views = at_one_scale(evidence, views)
    have_corners = not all(is_round(model) or is_smooth(model) for model in models)
    # The proposals of the pictures are the same for all models.
    maps = SceneMaps.of(evidence, views)
    paths, edges = _picture_proposals(evidence, views, options) if have_corners else ([], [])
    junctions = _junctions_alone(evidence, views) if have_corners else None
    hypotheses: list[Hypothesis] = []
    ellipses: list[SeenEllipses] = []
    for index, model in enumerate(models):
        if is_round(model) or is_smooth(model):
            ellipses = ellipses or seen_ellipses(evidence, views, options.round_parts)
            propose = poses_from_outlines if is_smooth(model) else poses_from_circles
            proposals = propose(ellipses, model, options.round_parts)
            hypotheses += _round_hypotheses(proposals, model, index, count, box, options)
            continue
        proposed = [
            poses_from_paths(view_paths, model, camera_from_world)
            for view_paths, camera_from_world in zip(paths, views.camera_from_world, strict=True)
        ]
        proposed += [poses_from_edges(pair, model) for pair in edges]
        best, scores, shares = _best(
            maps, model, np.concatenate(proposed), junctions, count, box, options
        )
        hypotheses += [
            # Scores of different models compare: both are lengths in the same pictures.
            Hypothesis(index, pose, float(score), float(share))
            for pose, score, share in zip(best, scores, shares, strict=True)
        ]
    return sorted(hypotheses, key=lambda h: -h.score)


def at_one_scale(
    pictures: Sequence[PictureEvidence], views: SeenViews
) -> tuple[tuple[PictureEvidence, ...], SeenViews]:
    """Return the evidence of all pictures at the scale of the sharpest one, and the views.

    The cameras of the returned views are the cameras of the resized pictures.

    Args:
        pictures: of all views.
        views: with the cameras that took them, or already with the resized pictures' cameras.
    """
    # Numbers that differ are refused by whatever looks into the pictures.
    both = list(zip(pictures, views.cameras, strict=False))
    if all(picture.features.image_size == camera.image_size for picture, camera in both):
        return tuple(pictures), views
    scale = max(picture.scale for picture in pictures)
    alike = tuple(picture.at(scale, camera) for picture, camera in both)
    scaled = [scaled_camera(camera, scale) for camera in distinct_cameras(views.camera)]
    return alike, views._replace(camera=with_cameras(views.camera, scaled))


def _round_hypotheses(
    proposals: tuple[Float[np.ndarray, "poses 4 4"], Float[np.ndarray, "poses 2"]],
    model: ObjectModel,
    index: int,
    count: int,
    box: Float[np.ndarray, "2 3"] | None,
    options: SearchOptions,
) -> list[Hypothesis]:
    """Return the best hypotheses of a model without corners: ellipses are near enough as they are.

    The arguments are as in `find_hypotheses`, with the index of the model, the proposed poses, and
    their visible and supported lengths.
    """
    poses, lengths = proposals
    inside = _are_within(model, poses, box, options)
    poses, (visible, supported) = poses[inside], lengths[inside].T
    scores = supported - options.chance_support * visible
    # The others have less on edges than chance would put there.
    order = np.argsort(-scores, kind="stable")[: int((scores > 0.0).sum())]
    kept = order[distinct_poses(model, poses[order], count)]
    return [
        Hypothesis(index, poses[k], float(scores[k]), float(supported[k] / max(visible[k], 1e-9)))
        for k in kept
    ]


def checked_box(workspace: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """Return two corners of a box, the lower bounds first; raise a ValueError if invalid."""
    corners = np.asarray(workspace, dtype=float)
    # NaN compares as False.
    if corners.shape != (2, 3) or not (np.abs(corners) <= MAX_COORDINATE).all():
        raise ValueError(
            f"workspace: expected two corners (2, 3), finite, m, up to {MAX_COORDINATE:g}; found "
            f"{workspace}"
        )
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _picture_proposals(
    evidence: Sequence[PictureEvidence], views: SeenViews, options: SearchOptions
) -> tuple[list[PicturePaths], list[SpaceEdges]]:
    """Return the paths of each picture, and the edges in space of pairs of pictures."""
    planes, poses = [IdealPlane(camera) for camera in views.cameras], views.camera_from_world
    features = [picture.features for picture in evidence]
    # A single picture has only paths; of two pictures they help where edges in space fail. Their
    # number is limited such that all pictures together propose about as many as two do.
    most = options.paths_alone if len(features) == 1 else 2 * options.paths // len(features)
    paths = [picture_paths(*view, most) for view in zip(features, planes, strict=True)]
    pairs = list(combinations(range(len(features)), 2))
    # Of many pictures, pair each with the next: all take part, and the time grows linearly.
    pairs = pairs if len(features) <= 3 else [(k, k + 1) for k in range(len(features) - 1)]
    edges = [
        stereo_edges(features[i], features[j], (planes[i], planes[j]), poses[[i, j]])
        for i, j in pairs
    ]
    return paths, edges


def _junctions_alone(evidence: Sequence[PictureEvidence], views: SeenViews) -> Junctions | None:
    """Return the junctions of a single picture; None for several, which propose enough."""
    if len(evidence) > 1:
        return None
    return Junctions.of(
        evidence[0].features, IdealPlane(views.cameras[0]), views.camera_from_world[0]
    )


def _best(
    maps: SceneMaps,
    model: ObjectModel,
    poses: Float[np.ndarray, "poses 4 4"],
    junctions: Junctions | None,
    count: int,
    box: Float[np.ndarray, "2 3"] | None,
    options: SearchOptions,
) -> tuple[Float[np.ndarray, "best 4 4"], Float[np.ndarray, "best"], Float[np.ndarray, "best"]]:
    """Return the best distinct poses after polishing, their scores, and their explained shares."""
    # One sample of a short edge is enough: the scores are lengths, and no line is fitted.
    coarse, fine = Wireframe.of(model, options.coarse_samples, per_edge=1), Wireframe.of(model)
    poses = _coarse_ranked(maps, coarse, model, poses, box, options)
    # A distinct object is proposed a hundred times, which would leave no room for the others.
    poses = poses[distinct_poses(model, poses, options.finer_scored)]
    wider = np.zeros((0, 4, 4))
    if junctions is not None:
        wider = poses_from_triples(junctions, fine, poses[: options.widened])
        wider = _coarse_ranked(maps, coarse, model, wider, box, options)
        wider = wider[distinct_poses(model, wider, options.polished)]
    poses = _ranked(maps, fine, poses, options.coarse_gate, options)[0][: options.polished]
    # Selected separately: before polishing, a wrong pose that three junctions fit may explain
    # more than a right one.
    poses = np.concatenate([poses, wider])
    # A wide gate recovers proposals that are off by degrees, and loses some that were nearly
    # right.
    schedules = WIDE_GATES, NARROW_GATES
    poses = np.concatenate([polished_poses(maps, fine, poses, gates) for gates in schedules])
    # Polishing moves some poses out of the workspace.
    gate = options.fine_gate if junctions is None else options.fine_gate_alone
    poses = poses[_are_within(model, poses, box, options)]
    poses, scores, shares = _ranked(maps, fine, poses, gate, options)
    # Several proposals converge to the same pose.
    kept = distinct_poses(model, poses, count)
    return poses[kept], scores[kept], shares[kept]


def _coarse_ranked(
    maps: SceneMaps,
    coarse: Wireframe,
    model: ObjectModel,
    poses: Float[np.ndarray, "poses 4 4"],
    box: Float[np.ndarray, "2 3"] | None,
    options: SearchOptions,
) -> Float[np.ndarray, "best 4 4"]:
    """Return the best of many proposals, the best first."""
    poses = poses[_are_within(model, poses, box, options)]
    # Ten thousand proposals and more: few samples, and hidden lines as of convex objects only.
    return _ranked(maps, coarse, poses, options.coarse_gate, options, convex=True)[0][
        : options.compared
    ]


def _are_within(
    model: ObjectModel,
    poses: Float[np.ndarray, "poses 4 4"],
    box: Float[np.ndarray, "2 3"] | None,
    options: SearchOptions,
) -> Bool[np.ndarray, "poses"]:
    """Return at which poses all vertices are within a box and its slack; all, without a box."""
    if box is None:
        return np.ones(len(poses), dtype=bool)
    vertices = host_transformed(poses, model.vertices)
    low, high = box[0] - options.workspace_slack, box[1] + options.workspace_slack
    return ((vertices > low) & (vertices < high)).all(axis=(1, 2))


def _ranked(
    maps: SceneMaps,
    wireframe: Wireframe,
    poses: Float[np.ndarray, "poses 4 4"],
    gate: float,
    options: SearchOptions,
    *,
    convex: bool = False,
) -> tuple[Float[np.ndarray, "poses 4 4"], Float[np.ndarray, "poses"], Float[np.ndarray, "poses"]]:
    """Return poses, their scores and their explained shares, the best first."""
    lengths = score_poses(maps, wireframe, poses, gate, convex=convex)
    scores = lengths.support_px - options.chance_support * lengths.visible_px
    order = np.argsort(-scores, kind="stable")
    return poses[order], scores[order], lengths.explained[order]
