"""Tell an object from the shadow that an equal one casts on a plane.

The shadow of a flat face on a parallel plane has the face's own outline, displaced along the light:
it looks like the top of an equal object that is sunk into the plane. Both have the same edges in
the plane. They differ in the others, which a sunk object may show, such as the far rim of a hole.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from ...geometry import host_transformed
from ...modeling import SeenViews, project_points
from ..distinct_poses import pose_distances
from ..edges import EXPLAINED_DISTANCE, HIDING_MARGIN, EdgeLines, Wireframe
from ..refining import samples_in_views
from .candidates import Prepared
from .evidence import log_chance_of_exact_edges, log_likelihood_of, log_odds_of
from .options import DEFAULT_OPTIONS, VerdictOptions


def log_odds_to_shadow(
    lines: EdgeLines,
    entry: Prepared,
    views: SeenViews,
    pose: Float[np.ndarray, "4 4"],
    others: Sequence[Float[np.ndarray, "4 4"]],
    tolerance: float = 0.0,
    options: VerdictOptions = DEFAULT_OPTIONS,
) -> float | None:
    """Return how much likelier an object is than a shadow of an equal one, as a log-odds.

    The edges that the shadow has too are as likely with either, and cancel; where there is a shadow
    only, the others are found no more often than in clutter.

    Args:
        lines: edges measured at the pose.
        entry: the model.
        views: camera and poses.
        pose: world_from_object.
        others: world_from_object of equal objects that are known.
        tolerance: error of the poses, m, as `overlap_tolerance` returns.
        options: probabilities of edge points.

    Returns:
        natural logarithm; None where no other one casts such a shadow.
    """
    model, middle = entry.model, entry.middle_at(pose)
    slack = tolerance + HIDING_MARGIN * model.extent
    odds = []
    for other in others:
        shift, moved = middle - entry.middle_at(other), other.copy()
        moved[:3, 3] += shift
        # Turned otherwise, it would not have the outline of the other one's face.
        if pose_distances(model, moved, pose[None])[0] >= entry.same:
            continue
        light = pose[:3, :3].T @ shift
        for face in range(len(model.faces)):
            plane = model.plane(face)
            heights = (model.vertices - light - plane.origin) @ plane.normal
            # The other one, which is this one before the shift, is beyond the face's plane.
            if light @ plane.normal < 0.0 and heights.min() > -slack:
                curve = _shadow_on(entry.fine, face, light)
                pixels = project_points(views, host_transformed(pose, curve))
                odds.append(_log_odds_of_other_edges(lines, entry.fine, face, pixels, options))
    return min(odds, default=None)


def _shadow_on(
    wireframe: Wireframe, face: int, light: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Return points of the outline, as the light sees it, projected on the plane of a face.

    Args:
        wireframe: of the model.
        face: index of the face.
        light: direction in which the light travels.
    """
    is_lit = np.asarray(wireframe.face_normals) @ light < 0.0
    owners = np.asarray(wireframe.edge_faces)
    borders = np.flatnonzero((owners & is_lit).any(axis=1) & (owners & ~is_lit).any(axis=1))
    is_border = np.isin(np.asarray(wireframe.sample_edges), borders)
    points = np.asarray(wireframe.samples)[is_border]
    if wireframe.smooth is not None:
        along = np.asarray(wireframe.smooth.normals) @ light
        is_outline = (along[:, 0] < 0.0) != (along[:, 1] < 0.0)
        points = np.concatenate([points, np.asarray(wireframe.smooth.points)[is_outline]])
    normal = np.asarray(wireframe.face_normals)[face]
    heights = (points - np.asarray(wireframe.face_points)[face]) @ normal
    return points - np.outer(heights / (light @ normal), light)


def _log_odds_of_other_edges(
    lines: EdgeLines,
    wireframe: Wireframe,
    face: int,
    shadow: Float[np.ndarray, "views n 2"],
    options: VerdictOptions,
) -> float:
    """Return the log-odds of an object to clutter by the edges that a shadow does not have.

    Args:
        lines: edges of the object.
        wireframe: of the model.
        face: index of the face.
        shadow: pixels of the shadow's outline.
        options: probabilities of edge points.
    """
    on_face = np.asarray(wireframe.edge_faces)[np.asarray(wireframe.sample_edges), face]
    on_face &= np.asarray(wireframe.sample_chains) >= 0
    has_edge = np.isfinite(lines.distances)
    is_other = ~on_face & ~(has_edge & _near(lines, shadow))
    visible_px = float((lines.sample_px * is_other).sum())
    explained_px = float((lines.sample_px * (is_other & has_edge)).sum())
    likelihood = log_likelihood_of(explained_px / max(visible_px, 1.0), visible_px, options)
    curves = np.broadcast_to(samples_in_views(lines, wireframe)[1], has_edge.shape)
    offsets = [
        lines.offsets[view, curve]
        for view, of_view in enumerate(curves)
        for curve in np.unique(of_view[is_other[view] & has_edge[view]])
        if lines.measured[view, curve]
    ]
    distances = np.linalg.norm(np.reshape(offsets, (-1, 2)), axis=1)
    return log_odds_of(likelihood, log_chance_of_exact_edges(distances))


def _near(lines: EdgeLines, shadow: Float[np.ndarray, "views n 2"]) -> Bool[np.ndarray, "views S"]:
    """Return which samples have an edge point that the outline of a shadow explains as well."""
    points = lines.samples + np.nan_to_num(lines.distances)[..., None] * lines.normals
    gaps = [
        KDTree(curve[np.isfinite(curve).all(axis=1)]).query(pixels)[0]
        for curve, pixels in zip(shadow, points, strict=True)
    ]
    return np.stack(gaps) < EXPLAINED_DISTANCE
