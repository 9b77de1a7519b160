"""Match a model's vertices and edges with corners and segments, one after the other.

The scheme follows Kosaka and Kak ("Stereo Vision for Industrial Applications", Handbook of
Industrial Robotics, 1999, and FINALE, CVGIP: Image Understanding 56(3), 1992): from a pose with a
covariance every visible feature is predicted with its search ellipse; candidates within a
chi-square gate are tried, the least ambiguous feature first; every match updates the pose by an
iterated Kalman step, which shrinks the other ellipses; where matches contradict one another later,
the search backtracks, and a feature may have no match ("nil").

It is the baseline. Each match counts the errors of the calibration as independent; the batch fit
of all matches, `pose_from_matches`, treats them as common.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.stats import chi2

from ..cameras import Camera
from ..features import Features, IdealPlane
from ..geometry import host_exponentials, host_logarithms
from ..modeling import CalibrationUncertainty, ObjectModel, SeenViews
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from .match_equations import Matches, match_equations
from .pose_equations import CommonErrors, PoseEquations, solve_pose
from .prediction import predict_view
from .wireframe import Wireframe

GATE_COVERAGE = 0.95
"""Probability that the true candidate lies within the gate, if prior and noise are as stated."""

BACKTRACKING_DEPTH = 4
"""Number of features, the first ones matched, for which alternative candidates are tried."""

MAX_CANDIDATES = 3
"""Largest number of candidates for each of these features, the nearest first; then nil."""

MAX_UPDATES = 400
"""Largest number of Kalman updates of a search, over all branches."""

UPDATE_ITERATIONS = 3
"""Largest number of linearisations of one Kalman update."""

MAX_ALIGNMENT_ERROR = float(np.deg2rad(25.0))
"""Largest angle between a segment and the predicted edge that it may match, rad."""

MAX_BEYOND = 0.15
"""Length by which a segment may exceed the predicted edge at either end, over the edge's length."""

NIL_COST = float(chi2.ppf(0.99, 2))
"""Squared Mahalanobis distance that is charged for a feature without a match."""


class PoseState(NamedTuple):
    """A pose with the covariance of its tangent."""

    world_from_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]


class MatchedPose(NamedTuple):
    """A pose after its features were matched.

    Attributes:
        state: pose and covariance after all updates.
        matches: matches of the features that have one.
        predicted: number of features that were predicted to be visible.
        cost: squared Mahalanobis distances of all matches, and `NIL_COST` for each nil.
        updates: number of Kalman updates of the whole search.
    """

    state: PoseState
    matches: Matches
    predicted: int
    cost: float
    updates: int


def kalman_update(
    state: PoseState,
    match: Matches,
    model: ObjectModel,
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
) -> tuple[PoseState, float]:
    """Return the pose after an iterated extended Kalman step for matches, and their distance.

    The distance is the squared Mahalanobis distance of the matches from their prediction.

    Args:
        state: pose and covariance before the update.
        match: one match or several.
        model: of the object.
        views: camera and poses.
        uncertainty: of the calibration in these views.
    """
    errors = CommonErrors.of(uncertainty, model)
    pose, squared = state.world_from_object, 0.0
    covariance = state.covariance
    for k in range(UPDATE_ITERATIONS):
        equations = match_equations(match, model, views, pose, uncertainty)
        if not len(equations.residuals):
            return state, np.inf
        # The prior's mean, relative to the current linearisation point.
        mean = host_logarithms(np.linalg.inv(pose) @ state.world_from_object)
        if k == 0:
            squared = _squared_distance(equations, errors, state.covariance)
        step = solve_pose(equations, errors, (mean, state.covariance))
        pose, covariance = pose @ host_exponentials(step.tangent), step.covariance
        if float(step.tangent @ np.linalg.solve(covariance, step.tangent)) < 1e-6:
            break
    return PoseState(pose, 0.5 * (covariance + covariance.T)), squared


def _squared_distance(
    equations: PoseEquations, errors: CommonErrors, covariance: Float[np.ndarray, "6 6"]
) -> float:
    """Return r^T (J P J^T + R)^-1 r, where P is the covariance of the pose."""
    J, r = equations.by_pose, equations.residuals
    total = equations.noise + sum(errors.covariances(equations)) + J @ covariance @ J.T
    return float(r @ np.linalg.solve(total, r))


class _Branch(NamedTuple):
    """A node of the search: the matches so far."""

    state: PoseState
    matches: Matches
    remaining: tuple[int, ...]
    cost: float
    depth: int


class _Search:
    """The search for the cheapest assignment: with backtracking near the root, greedy below."""

    def __init__(
        self,
        model: ObjectModel,
        views: SeenViews,
        uncertainty: CalibrationUncertainty,
        features: Sequence[Matches],
    ):
        self._model, self._views, self._uncertainty = model, views, uncertainty
        self._features = features
        self._errors = CommonErrors.of(uncertainty, model)
        self._gate = float(chi2.ppf(GATE_COVERAGE, 2))
        self.updates = 0
        self.best: _Branch | None = None

    def explore(self, branch: _Branch) -> None:
        """Match the remaining features of a branch; keep it if it is the cheapest so far."""
        if self.best is not None and branch.cost >= self.best.cost:
            return
        if not branch.remaining:
            self.best = branch
            return
        if self.updates >= MAX_UPDATES and self.best is not None:
            return
        feature, gated = self._least_ambiguous(branch)
        remaining = tuple(k for k in branch.remaining if k != feature)
        tried = MAX_CANDIDATES if branch.depth < BACKTRACKING_DEPTH else 1
        for candidate in gated[:tried]:
            match = _single(self._features[feature], candidate)
            state, squared = kalman_update(
                branch.state, match, self._model, self._views, self._uncertainty
            )
            self.updates += 1
            self.explore(
                _Branch(
                    state,
                    branch.matches.joined(match),
                    remaining,
                    branch.cost + squared,
                    branch.depth + 1,
                )
            )
        # Nil: always where no candidate is within the gate, and as an alternative near the root.
        if not len(gated) or branch.depth < BACKTRACKING_DEPTH:
            depth = branch.depth + (1 if len(gated) else 0)
            self.explore(
                branch._replace(remaining=remaining, cost=branch.cost + NIL_COST, depth=depth)
            )

    def _least_ambiguous(self, branch: _Branch) -> tuple[int, list[int]]:
        """Return the feature with the fewest candidates in its gate, and these, nearest first."""
        pooled = Matches.none()
        for k in branch.remaining:
            pooled = pooled.joined(self._features[k])
        distances, areas = self._distances(branch.state, pooled)
        best: tuple[tuple[int, float], int, list[int]] | None = None
        corner, segment = 0, len(pooled.corners)
        for k in branch.remaining:
            candidates = self._features[k]
            # Corners come before segments in the pooled matches.
            start, corner, segment = (
                (corner, corner + candidates.size, segment)
                if len(candidates.corners)
                else (segment, corner, segment + candidates.size)
            )
            squared = distances[start : start + candidates.size]
            gated = [int(j) for j in np.argsort(squared) if squared[j] <= self._gate]
            area = float(areas[start]) if candidates.size else np.inf
            # Features without candidates come last: they cannot reduce the ambiguity of others.
            rank = (len(gated) or len(pooled.corners) + len(pooled.segments) + 1, area)
            if best is None or rank < best[0]:
                best = (rank, k, gated)
        assert best is not None
        return best[1], best[2]

    def _distances(
        self, state: PoseState, pooled: Matches
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Return squared Mahalanobis distances of candidates, and areas of their ellipses."""
        distances, areas = np.full(pooled.size, np.inf), np.full(pooled.size, np.inf)
        if not pooled.size:
            return distances, areas
        equations = match_equations(
            pooled, self._model, self._views, state.world_from_object, self._uncertainty
        )
        blocks = equations.block[::2]
        n = len(blocks)
        J = equations.by_pose.reshape(n, 2, 6)
        B = equations.by_calibration.reshape(n, 2, -1)
        V = equations.by_vertices.reshape(n, 2, -1)
        rows = np.arange(2 * n).reshape(n, 2)
        total = equations.noise[rows[:, :, None], rows[:, None, :]]
        for derivative, covariance in (
            (J, state.covariance),
            (B, self._errors.calibration),
            (V, self._errors.vertices),
        ):
            total = total + derivative @ covariance @ derivative.swapaxes(1, 2)
        r = equations.residuals.reshape(n, 2, 1)
        distances[blocks] = (r.swapaxes(1, 2) @ np.linalg.solve(total, r))[:, 0, 0]
        areas[blocks] = np.linalg.det(total)
        return distances, areas


def match_features(
    model: ObjectModel,
    views: SeenViews,
    features: Sequence[Features],
    state: PoseState,
    uncertainty: CalibrationUncertainty | None = None,
) -> MatchedPose:
    """Return the pose and the matches found by a search from an uncertain pose.

    Args:
        model: of the object.
        views: camera and poses.
        features: corners and segments of each view.
        state: initial pose and covariance.
        uncertainty: of the calibration in these views; None for an exact one.

    Raises:
        ValueError: numbers of features and views that differ.
    """
    if len(features) != len(views.camera_from_world):
        raise ValueError(
            f"features: expected {len(views.camera_from_world)} views, found {len(features)}"
        )
    uncertainty = CalibrationUncertainty.none(views) if uncertainty is None else uncertainty
    predicted = _predicted_features(model, views, features, state.world_from_object)
    search = _Search(model, views, uncertainty, predicted)
    start = _Branch(state, Matches.none(), tuple(range(len(predicted))), 0.0, 0)
    search.explore(start)
    best = search.best if search.best is not None else start
    return MatchedPose(best.state, best.matches, len(predicted), best.cost, search.updates)


def _single(matches: Matches, index: int) -> Matches:
    """Return one of the matches, which are either all corners or all segments."""
    row = slice(index, index + 1)
    none = slice(0, 0)
    corners, segments = (row, none) if len(matches.corners) else (none, row)
    return Matches(
        *(part[corners] for part in matches[:4]), *(part[segments] for part in matches[4:])
    )


@compiled
def _predicted_pixels(
    wireframe: Wireframe, camera: Camera, camera_from_object: Float[Array, "4 4"]
) -> tuple[Float[Array, "V 2"], Bool[Array, "V"], Float[Array, "E"]]:
    """Return the pixels of vertices, whether they are visible, and the edges' visible lengths."""
    view = predict_view(wireframe, camera, camera_from_object)
    return jnp.nan_to_num(view.vertices), view.vertex_visible, view.edge_px


def _predicted_features(
    model: ObjectModel,
    views: SeenViews,
    features: Sequence[Features],
    world_from_object: Float[np.ndarray, "4 4"],
) -> list[Matches]:
    """Return the visible vertices and edges of all views with the corners and segments nearby."""
    wireframe, matches = Wireframe.of(model), []
    for view, (camera_from_world, in_view) in enumerate(
        zip(views.camera_from_world, features, strict=True)
    ):
        pixels, visible, edge_px = map(
            np.asarray,
            _predicted_pixels(
                wireframe, views.camera, to_device(camera_from_world @ world_from_object)
            ),
        )
        # The width of the object in the picture bounds how far a feature may be from its
        # prediction.
        reach = 0.25 * float(np.ptp(pixels[: len(model.vertices)], axis=0).max())
        for vertex in np.flatnonzero(visible[: len(model.vertices)]):
            near = np.linalg.norm(in_view.corners - pixels[vertex], axis=1) < reach
            matches.append(_corner_matches(in_view, view, int(vertex), np.flatnonzero(near)))
        covariances = segment_covariances(in_view, views.camera)
        for edge in np.flatnonzero(edge_px[: len(model.edges)] > 10.0):
            near = _segments_along(in_view, pixels[model.edges[edge]], reach)
            matches.append(_segment_matches(in_view, covariances, view, int(edge), near))
    return matches


def segment_covariances(features: Features, camera: Camera) -> Float[np.ndarray, "segments 2 2"]:
    """Return the covariances of the distances of both ends across each segment, px^2."""
    # The distance of the ray (x, f) from the plane of normal n is (x, f) . n / |n_xy|, in px.
    plane = IdealPlane(camera)
    ends = plane.from_pixels(features.segments.reshape(-1, 2)).reshape(-1, 2, 2)
    rays = np.concatenate([ends, np.full((*ends.shape[:2], 1), plane.focal_length)], axis=2)
    G = rays / np.linalg.norm(features.lines[:, :2], axis=1)[:, None, None]
    return G @ features.line_covariances @ G.swapaxes(1, 2)


def _corner_matches(features: Features, view: int, vertex: int, near: np.ndarray) -> Matches:
    """Return the matches of one vertex with each of several corners."""
    return Matches.none()._replace(
        corner_view=np.full(len(near), view),
        corner_vertex=np.full(len(near), vertex),
        corners=features.corners[near],
        corner_covariances=features.corner_covariances[near],
    )


def _segment_matches(
    features: Features, covariances: np.ndarray, view: int, edge: int, near: np.ndarray
) -> Matches:
    """Return the matches of one edge with each of several segments."""
    return Matches.none()._replace(
        segment_view=np.full(len(near), view),
        segment_edge=np.full(len(near), edge),
        segments=features.segments[near],
        segment_covariances=covariances[near],
    )


def _segments_along(features: Features, edge: Float[np.ndarray, "2 2"], reach: float) -> np.ndarray:
    """Return the segments nearly parallel to a predicted edge and near it, within its ends."""
    direction = edge[1] - edge[0]
    length = float(np.linalg.norm(direction))
    if length < 1.0 or not len(features.segments):
        return np.zeros(0, dtype=int)
    direction = direction / length
    segments = features.segments[:, 1] - features.segments[:, 0]
    cosine = np.abs(segments @ direction) / np.maximum(np.linalg.norm(segments, axis=1), 1e-9)
    offset = features.segments - edge[0]
    along = offset @ direction / length
    across = np.abs(offset @ np.array([-direction[1], direction[0]])).max(axis=1)
    within = (along.min(axis=1) > -MAX_BEYOND) & (along.max(axis=1) < 1.0 + MAX_BEYOND)
    return np.flatnonzero(within & (cosine > np.cos(MAX_ALIGNMENT_ERROR)) & (across < reach))
