"""Refine hypotheses on the edges of the pictures; the results are the candidates to be judged."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...geometry import host_transformed
from ...modeling import CalibrationUncertainty, ObjectModel
from ..distinct_poses import pose_distances
from ..edges import EDGE_SAMPLES, Wireframe
from ..refining import FIT_SAMPLES, lengths_of_poses, poses_on_edges
from ..rig_noise import ViewDisagreement
from ..search import DEFAULT_SEARCH_OPTIONS, Hypothesis, SearchOptions
from .evidence import log_likelihood_of
from .options import VerdictOptions
from .scene import Scene

SAME_POSE = 0.04
"""Largest RMS vertex distance of two poses that count as the same, over the model's extent."""


class Prepared(NamedTuple):
    """A model with a coarse and a fine wireframe: few and many samples along its edges."""

    model: ObjectModel
    coarse: Wireframe
    fine: Wireframe

    @classmethod
    def of(cls, model: ObjectModel) -> "Prepared":
        """Return a model with its wireframes."""
        return cls(model, Wireframe.of(model, EDGE_SAMPLES), Wireframe.of(model, FIT_SAMPLES))

    @property
    def same(self) -> float:
        """The largest RMS vertex distance of two poses that count as the same, m."""
        return SAME_POSE * self.model.extent

    def middle_at(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
        """Return the middle of the vertices in the world, m."""
        return host_transformed(pose, self.model.vertices.mean(axis=0))


class Query(NamedTuple):
    """The models that are looked for, the place, and the limits of the verdict.

    Attributes:
        models: models of the objects that may be there.
        uncertainty: of the calibration in the views.
        options: limits of the verdict.
        workspace: two corners of a box in the world that contains the objects, m; None for
            anywhere.
        disagreement: of the views as given, which were corrected by it; None for given views.
        search: limits of the search.
    """

    models: Sequence[Prepared]
    uncertainty: CalibrationUncertainty
    options: VerdictOptions
    workspace: Float[np.ndarray, "2 3"] | None = None
    disagreement: ViewDisagreement | None = None
    search: SearchOptions = DEFAULT_SEARCH_OPTIONS


class Candidate(NamedTuple):
    """A pose that was refined on the edges of the pictures.

    Attributes:
        model: index of the model.
        pose: world_from_object.
        visible_px, explained_px: visible edge length, and the part of it that is explained.
        log_likelihood: log-likelihood ratio of the object to clutter.
    """

    model: int
    pose: Float[np.ndarray, "4 4"]
    visible_px: float
    explained_px: float
    log_likelihood: float

    @classmethod
    def measured(
        cls,
        model: int,
        pose: Float[np.ndarray, "4 4"],
        lengths: Float[np.ndarray, "2"],
        options: VerdictOptions,
    ) -> "Candidate":
        """Return a pose with its visible and its explained length, px."""
        visible, explained = map(float, lengths)
        share = explained / max(visible, 1.0)
        return cls(model, pose, visible, explained, log_likelihood_of(share, visible, options))

    @property
    def explained(self) -> float:
        """The explained share of the visible edge length."""
        return self.explained_px / max(self.visible_px, 1.0)


def converged_candidates(
    scene: Scene, query: Query, hypotheses: Sequence[Hypothesis]
) -> list[Candidate]:
    """Return hypotheses refined on the edges, without duplicates, the likeliest first."""
    candidates = []
    for index, entry in enumerate(query.models):
        starts = [h.world_from_object for h in hypotheses if h.model == index]
        if not starts:
            continue
        poses, lengths = poses_on_edges(entry.coarse, scene.views, scene.lookup, np.stack(starts))
        refined = [
            Candidate.measured(index, pose, of_pose, query.options)
            for pose, of_pose in zip(poses, lengths, strict=True)
        ]
        kept: list[Candidate] = []
        for candidate in sorted(refined, key=lambda c: -c.explained):
            others = [other.pose for other in kept]
            # Many hypotheses converge to the same pose; the one that explains most is kept.
            if (
                not kept
                or pose_distances(entry.model, candidate.pose, np.stack(others)).min() > entry.same
            ):
                kept.append(candidate)
        candidates += kept
    return sorted(candidates, key=lambda c: -c.log_likelihood)


def measured_candidates(
    scene: Scene, query: Query, poses: Sequence[tuple[int, Float[np.ndarray, "4 4"]]]
) -> list[Candidate]:
    """Return poses of models measured on the edge points that are still free, likeliest first."""
    measured = []
    for index, entry in enumerate(query.models):
        own = [pose for model, pose in poses if model == index]
        if own:
            lengths = lengths_of_poses(entry.coarse, scene.views, scene.lookup, np.stack(own))
            measured += [
                Candidate.measured(index, pose, of_pose, query.options)
                for pose, of_pose in zip(own, lengths, strict=True)
            ]
    return sorted(measured, key=lambda c: -c.log_likelihood)
