"""Draw hypotheses to the edges of the pictures: the candidates that are judged.

A scene knows which edge points no object explains yet, and what known surfaces hide.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..features import PictureEvidence
from ..modeling import ObjectModel, SeenViews
from .distinct_poses import pose_distances
from .edge_lines import EXPLAINED_DISTANCE, EdgeLines
from .edge_lookup import EdgeLookup
from .evidence import Evidence, evidence_of, log_likelihood_of
from .hypotheses import Hypothesis
from .known_surfaces import KnownSurfaces
from .pose_convergence import lengths_of_poses, poses_on_edges
from .refinement import FIT_SAMPLES, explained_edge_points, measured_lines
from .wireframe import EDGE_SAMPLES, Wireframe

MAX_HYPOTHESES = 24
"""Largest number of hypotheses of each model that are drawn to the pictures' edges."""

SAME_POSE = 0.04
"""Largest RMS distance between the vertices of poses that count as one, over the model's extent."""

TYPICAL_CHANCE = 0.25
"""The share of an edge that clutter is taken to explain until it is measured, to rank poses."""


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
    def extent(self) -> float:
        """The largest size of the model along an axis, m."""
        return float(np.ptp(self.model.vertices, axis=0).max())

    @property
    def same(self) -> float:
        """The distance between the vertices of poses that count as one, m."""
        return SAME_POSE * self.extent

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


class Scene:
    """The pictures of one scene, and which of their edge points no object explains yet."""

    def __init__(
        self,
        views: SeenViews,
        pictures: Sequence[PictureEvidence],
        known: Float[np.ndarray, "triangles 3 3"],
    ):
        self.views, self.pictures, self.known = views, pictures, known
        # The points stay as they are; only which of them are free changes.
        self._points = [one.edge_points for one in pictures]
        self._lone = [one.lone for one in pictures]
        self._free = [np.ones(len(points.pixels), dtype=bool) for points in self._points]
        self._strengths = [points.strengths for points in self._points]
        self._surfaces = KnownSurfaces(views)
        self._surfaces.add_triangles(known)
        self.lookup: EdgeLookup = self._lookup()

    def _lookup(self) -> EdgeLookup:
        size, depths = self.views.camera.image_size, self._surfaces.inverse_depth
        return EdgeLookup.of(self._points, size, self._free, depths, self._lone)

    def take(
        self,
        lines: EdgeLines,
        wireframe: Wireframe | None = None,
        pose: Float[np.ndarray, "4 4"] | None = None,
    ) -> None:
        """Take edge points that an object explains away from all others.

        Args:
            lines: what it explains.
            wireframe, pose: of an object that hides what is behind it.
        """
        if wireframe is not None and pose is not None:
            self._surfaces.add(wireframe, pose)
        for view, (free, points) in enumerate(zip(self._free, self._points, strict=True)):
            free[explained_edge_points(lines, view, points)] = False
        self.lookup = self._lookup()

    def lines(
        self,
        pose: Float[np.ndarray, "4 4"],
        wireframe: Wireframe,
        views: SeenViews | None = None,
    ) -> EdgeLines:
        """Return the free edge points along the edges at a pose, in views that may be corrected."""
        views = self.views if views is None else views
        return measured_lines(wireframe, views, self.lookup, pose, EXPLAINED_DISTANCE)

    def evidence(
        self, lines: EdgeLines, wireframe: Wireframe, chance: float, absorbed: float = 0.0
    ) -> Evidence:
        """Return what `lines` say of their pose."""
        return evidence_of(lines, wireframe, self._strengths, chance, absorbed)

    def measured(
        self, prepared: Sequence[Prepared], candidates: Sequence[Candidate]
    ) -> list[Candidate]:
        """Return candidates with their lengths among the free edge points, the likeliest first."""
        found = []
        for index, one in enumerate(prepared):
            poses = [c.pose for c in candidates if c.model == index]
            if poses:
                lengths = lengths_of_poses(one.coarse, self.views, self.lookup, np.stack(poses))
                found += [
                    Candidate(index, pose, *map(float, own))
                    for pose, own in zip(poses, lengths, strict=True)
                ]
        return sorted(found, key=lambda one: -one.log_likelihood())


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
