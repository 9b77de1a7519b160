"""Write the equations of corners and segments matched with vertices and edges."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..modeling import CalibrationUncertainty, ObjectModel, SeenViews, pixel_jacobians
from .pose_equations import PoseEquations


class Matches(NamedTuple):
    """Corners and segments of pictures, and the vertices and edges that they match.

    Attributes:
        corner_view, corner_vertex: view and vertex of each corner.
        corners: px.
        corner_covariances: px^2.
        segment_view, segment_edge: view and edge of each segment.
        segments: their ends, px, not necessarily the ends of the edge.
        segment_covariances: of the two ends' distances across the segment, px^2.
    """

    corner_view: Int[np.ndarray, "corners"]
    corner_vertex: Int[np.ndarray, "corners"]
    corners: Float[np.ndarray, "corners 2"]
    corner_covariances: Float[np.ndarray, "corners 2 2"]
    segment_view: Int[np.ndarray, "segments"]
    segment_edge: Int[np.ndarray, "segments"]
    segments: Float[np.ndarray, "segments 2 2"]
    segment_covariances: Float[np.ndarray, "segments 2 2"]

    @classmethod
    def none(cls) -> "Matches":
        """Return an empty set of matches."""
        empty = np.zeros(0, dtype=int)
        return cls(
            empty,
            empty,
            np.zeros((0, 2)),
            np.zeros((0, 2, 2)),
            empty,
            empty,
            np.zeros((0, 2, 2)),
            np.zeros((0, 2, 2)),
        )

    def joined(self, other: "Matches") -> "Matches":
        """Return the matches of both."""
        return Matches(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    @property
    def size(self) -> int:
        """The number of corners and segments."""
        return len(self.corners) + len(self.segments)


def match_equations(
    matches: Matches,
    model: ObjectModel,
    views: SeenViews,
    world_from_object: Float[np.ndarray, "4 4"],
    uncertainty: CalibrationUncertainty,
) -> PoseEquations:
    """Return the equations of matches about the tangent at a pose: two for each match.

    A corner gives its pixel; a segment gives the distances of its ends from the predicted edge.
    Features that cannot be projected are left out.

    Args:
        matches: of any views.
        model: of the object.
        views: camera and poses.
        world_from_object: pose at which the equations are linear.
        uncertainty: of the calibration in these views.
    """
    corners, segments = len(matches.corners), len(matches.segments)
    view = np.concatenate([matches.corner_view, np.repeat(matches.segment_view, 2)])
    on_edges, fraction = _nearest_on_edges(matches, model, views, world_from_object)
    points = np.concatenate([model.vertices[matches.corner_vertex], on_edges.reshape(-1, 3)])
    R, t = world_from_object[:3, :3], world_from_object[:3, 3]
    projected = pixel_jacobians(views, points @ R.T + t)
    rows = np.arange(len(points))
    pixels, valid = projected.pixels[view, rows], projected.valid[view, rows]
    by_point, by_view = projected.by_point[view, rows] @ R, projected.by_view[view, rows]
    measured = np.concatenate([matches.corners, matches.segments.reshape(-1, 2)])
    # One row for each equation: both coordinates of a corner, the normal of a segment.
    directions = model.vertices[model.edges[matches.segment_edge]]
    tangents = np.einsum(
        "nij,nj->ni",
        by_point[corners:],
        np.repeat(directions[:, 1] - directions[:, 0], 2, axis=0),
    )
    lengths = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = tangents / np.where(lengths > 0.0, lengths, 1.0)
    across = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    row = np.concatenate([np.repeat(np.arange(corners), 2), np.arange(corners, len(points))])
    normals = np.concatenate([np.tile(np.eye(2), (corners, 1)), across])
    residuals = np.einsum("ni,ni->n", normals, (measured - pixels)[row])
    gradient = np.einsum("ni,nij->nj", normals, by_point[row])
    # x = R (p + v + w x p): the gradient is g by v, and p x g by w.
    by_pose = np.column_stack([gradient, np.cross(points[row], gradient)])
    sensitivity = np.einsum("ni,nij->nj", normals, by_view[row])
    by_calibration = np.einsum("nl,nlk->nk", sensitivity, uncertainty.view_jacobian[view[row]])
    count = corners + segments
    noise = np.zeros((2 * count, 2 * count))
    blocks = np.concatenate([matches.corner_covariances, matches.segment_covariances])
    for k, block in enumerate(blocks):
        noise[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    equations = PoseEquations(
        residuals,
        by_pose,
        noise,
        by_calibration,
        _by_vertices(matches, model, gradient, fraction),
        np.repeat(np.arange(count), 2),
    )
    usable = valid[row].reshape(-1, 2).all(axis=1)
    return equations.of(np.repeat(usable, 2))


def _nearest_on_edges(
    matches: Matches,
    model: ObjectModel,
    views: SeenViews,
    world_from_object: Float[np.ndarray, "4 4"],
) -> tuple[Float[np.ndarray, "segments 2 3"], Float[np.ndarray, "segments 2"]]:
    """Return the points of edges that are seen nearest to the segments' ends, and their places.

    A place is 0 at the first vertex of the edge and 1 at the second.
    """
    if not len(matches.segments):
        return np.zeros((0, 2, 3)), np.zeros((0, 2))
    R, t = world_from_object[:3, :3], world_from_object[:3, 3]
    ends = pixel_jacobians(views, model.vertices @ R.T + t).pixels
    edges = model.edges[matches.segment_edge]
    a, b = (ends[matches.segment_view, edges[:, k]] for k in (0, 1))
    along = b - a
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    s = np.einsum("nki,ni->nk", matches.segments - a[:, None], along) / squared[:, None]
    # Perspective: a point at s in the picture is at s z_a / (s z_a + (1 - s) z_b) on the edge.
    cameras = views.camera_from_world[matches.segment_view] @ world_from_object
    vertices = model.vertices[edges]
    z = np.einsum("nj,nkj->nk", cameras[:, 2, :3], vertices) + cameras[:, 2, 3:]
    s = np.clip(s, 0.0, 1.0)
    # In perspective the weight of each vertex is inverse to its depth.
    first, second = (1.0 - s) / z[:, :1], s / z[:, 1:]
    fraction = second / (first + second)
    points = (1.0 - fraction[..., None]) * vertices[:, :1] + fraction[..., None] * vertices[:, 1:]
    return points, fraction


def _by_vertices(
    matches: Matches,
    model: ObjectModel,
    gradient: Float[np.ndarray, "n 3"],
    fraction: Float[np.ndarray, "segments 2"],
) -> Float[np.ndarray, "n coordinates"]:
    """Return derivatives of equations by the vertices' coordinates; none for an exact model."""
    if model.is_exact:
        return np.zeros((len(gradient), 0))
    derivatives = np.zeros((len(gradient), len(model.vertices), 3))
    corner_rows = 2 * len(matches.corners)
    rows = np.arange(len(gradient))
    derivatives[rows[:corner_rows], np.repeat(matches.corner_vertex, 2)] = gradient[:corner_rows]
    edges = np.repeat(model.edges[matches.segment_edge], 2, axis=0)
    for k, share in enumerate((1.0 - fraction.ravel(), fraction.ravel())):
        derivatives[rows[corner_rows:], edges[:, k]] = share[:, None] * gradient[corner_rows:]
    return derivatives.reshape(len(gradient), -1)
