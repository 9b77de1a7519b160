"""Find the poses at which known objects may be in the pictures, without a start.

Poses are proposed from corners and segments, scored by the edges of all pictures, made distinct,
drawn to the edges, and scored again. Nothing is accepted here: every hypothesis is still to be
fitted and judged.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..features import IdealPlane, PictureEvidence
from ..modeling import ObjectModel, SeenViews
from .corner_paths import picture_paths, poses_from_paths
from .distinct_poses import distinct_poses
from .polishing import polished_poses
from .scoring import PoseScores, SceneMaps, score_poses
from .stereo_edges import poses_from_edges, stereo_edges
from .wireframe import Wireframe

MAX_PATHS_ALONE, MAX_PATHS = 300, 100
"""Largest number of paths of a picture, where it is the only one and where there are more."""

COARSE_SAMPLES, COARSE_GATE = 24, 8.0
"""Samples of the wireframe for the first scores, and their gate, px: proposals err by some px."""

FINE_GATE = 4.0
"""Gate of the scores of polished poses, px."""

FINER_SCORED = 1024
"""Number of proposals that are scored once more with all samples."""

POLISHED = 64
"""Number of distinct proposals that are polished."""


class Hypothesis(NamedTuple):
    """A pose at which an object may be.

    Attributes:
        model: index of the model.
        world_from_object: the pose.
        score: length in all pictures that lies on edges of its own direction, beyond what other
            edges would explain by chance, px; what lies nearer counts more.
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
    count: int = 20,
) -> list[Hypothesis]:
    """Return where objects may be, the best hypotheses first.

    Args:
        evidence: of each picture.
        views: the camera's poses at the pictures; one is enough, two or more tell far more.
        models: of the objects that may be there. Their symmetry, if known, keeps equal poses from
            being listed several times.
        count: largest number of hypotheses.

    Raises:
        ValueError: no pictures or no models, other numbers of pictures than of poses, or a model
            without edges.
    """
    if not len(models):
        raise ValueError("models: expected at least one, found none")
    maps = SceneMaps.of(evidence, views)
    plane = IdealPlane(views.camera)
    most = MAX_PATHS_ALONE if len(evidence) == 1 else MAX_PATHS
    paths = [picture_paths(one.features, plane, most) for one in evidence]
    edges = [
        stereo_edges(
            evidence[i].features, evidence[j].features, plane, views.camera_from_world[[i, j]]
        )
        for i, j in combinations(range(len(evidence)), 2)
    ]
    found: list[Hypothesis] = []
    for index, model in enumerate(models):
        proposed = [
            poses_from_paths(own, model, camera_from_world)
            for own, camera_from_world in zip(paths, views.camera_from_world, strict=True)
        ]
        proposed += [poses_from_edges(pair, model) for pair in edges]
        best, scores = _best(maps, model, np.concatenate(proposed), count)
        found += [
            Hypothesis(index, pose, float(score), float(share))
            for pose, score, share in zip(best, scores.surplus_px, scores.explained, strict=True)
        ]
    return sorted(found, key=lambda one: -one.score)[:count]


def _best(
    maps: SceneMaps, model: ObjectModel, poses: Float[np.ndarray, "poses 4 4"], count: int
) -> tuple[Float[np.ndarray, "best 4 4"], PoseScores]:
    """Return the best distinct poses after polishing, with their scores."""
    coarse, fine = Wireframe.of(model, COARSE_SAMPLES), Wireframe.of(model)
    poses = _ranked(maps, coarse, poses, COARSE_GATE)[0][:FINER_SCORED]
    poses = _ranked(maps, fine, poses, COARSE_GATE)[0]
    poses = poses[distinct_poses(model, poses, POLISHED)]
    poses, scores = _ranked(maps, fine, polished_poses(maps, fine, poses), FINE_GATE)
    kept = distinct_poses(model, poses, count)
    return poses[kept], PoseScores(*(part[kept] for part in scores))


def _ranked(
    maps: SceneMaps, wireframe: Wireframe, poses: Float[np.ndarray, "poses 4 4"], gate: float
) -> tuple[Float[np.ndarray, "poses 4 4"], PoseScores]:
    """Return poses and their scores, the best first."""
    scores = score_poses(maps, wireframe, poses, gate)
    order = np.argsort(-scores.surplus_px, kind="stable")
    return poses[order], PoseScores(*(part[order] for part in scores))
