"""Draw hypotheses to the edges of the pictures: the candidates that are judged."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..modeling import ObjectModel
from .distinct_poses import pose_distances
from .evidence import TYPICAL_CHANCE, log_likelihood_of
from .hypotheses import MAX_HYPOTHESES, Hypothesis
from .pose_convergence import lengths_of_poses, poses_on_edges
from .refinement import FIT_SAMPLES
from .scene import Scene
from .wireframe import EDGE_SAMPLES, Wireframe

SAME_POSE = 0.04
"""Largest RMS distance between the vertices of poses that count as one, over the model's extent."""


class Prepared(NamedTuple):
    """A model with its wireframes, of few samples and of many."""

    model: ObjectModel
    coarse: Wireframe
    fine: Wireframe

    @classmethod
    def of(cls, model: ObjectModel) -> "Prepared":
        """Return a model with its wireframes."""
        return cls(model, Wireframe.of(model, EDGE_SAMPLES), Wireframe.of(model, FIT_SAMPLES))

    @property
    def same(self) -> float:
        """The distance between the vertices of poses that count as one, m."""
        return SAME_POSE * self.model.extent

    def middle_at(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """Return the middle of the vertices in the world, m."""
        return pose[:3, :3] @ self.model.vertices.mean(axis=0) + pose[:3, 3]


class Candidate(NamedTuple):
    """A pose that was drawn to the edges of the pictures.

    Attributes:
        model: index of the model.
        pose: world_from_object.
        visible_px, explained_px: visible edge length, and the part of it that is explained.
    """

    model: int
    pose: Float[np.ndarray, "4 4"]
    visible_px: float
    explained_px: float

    @property
    def explained(self) -> float:
        """The explained share of the visible edge length."""
        return self.explained_px / max(self.visible_px, 1.0)

    def log_likelihood(self, chance: float = TYPICAL_CHANCE) -> float:
        """Return the log-likelihood over that of clutter."""
        return log_likelihood_of(self.explained, self.visible_px, chance)


def converged_candidates(
    scene: Scene, prepared: Sequence[Prepared], hypotheses: Sequence[Hypothesis]
) -> list[Candidate]:
    """Return hypotheses drawn to the edges of the pictures, each once, the likeliest first."""
    candidates = []
    for index, one in enumerate(prepared):
        # The hypotheses are ranked, so that the limit leaves out the least likely.
        starts = [h.world_from_object for h in hypotheses if h.model == index][:MAX_HYPOTHESES]
        if not starts:
            continue
        poses, lengths = poses_on_edges(one.coarse, scene.views, scene.lookup, np.stack(starts))
        own = [
            Candidate(index, pose, *map(float, of_pose))
            for pose, of_pose in zip(poses, lengths, strict=True)
        ]
        kept: list[Candidate] = []
        for each in sorted(own, key=lambda one: -one.explained):
            others = [other.pose for other in kept]
            # Many hypotheses are drawn to one pose: the one that explains most stands for them.
            if not kept or pose_distances(one.model, each.pose, np.stack(others)).min() > one.same:
                kept.append(each)
        candidates += kept
    return sorted(candidates, key=lambda one: -one.log_likelihood())


def measured_candidates(
    scene: Scene, prepared: Sequence[Prepared], candidates: Sequence[Candidate]
) -> list[Candidate]:
    """Return candidates with their lengths among the free edge points, the likeliest first."""
    found = []
    for index, one in enumerate(prepared):
        poses = [c.pose for c in candidates if c.model == index]
        if poses:
            lengths = lengths_of_poses(one.coarse, scene.views, scene.lookup, np.stack(poses))
            found += [
                Candidate(index, pose, *map(float, own))
                for pose, own in zip(poses, lengths, strict=True)
            ]
    return sorted(found, key=lambda one: -one.log_likelihood())
