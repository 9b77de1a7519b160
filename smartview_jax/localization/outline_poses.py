"""Propose poses of smooth parts, which have no edges, from the ellipses in the pictures.

The outline of a ring, a knob or an egg looks like an ellipse from most viewpoints. Seen from each
of many directions the convex hull of the part has two axes, as its moments say; where an ellipse
has axes of the same ratio, their size gives the distance, and their direction the turn in the
picture. The poses are scored by how much of the outline lies on edge points of all pictures.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from ..geometry import host_exponentials, host_poses, spiral_directions
from ..modeling import ObjectModel
from .circle_poses import DEFAULT_ROUND_OPTIONS, RoundOptions, SeenEllipses, supported_lengths
from .distinct_poses import distinct_poses
from .outlines import OutlineSamples


class SeenHull(NamedTuple):
    """An ellipse with the moments of a part's convex hull, as seen from one direction.

    Attributes:
        turn: rotation whose rows are the directions of the long and the short axis and the line of
            sight, in the object's frame.
        middle: point of the object that is seen at the ellipse's middle, m.
        axes: half of the long and of the short axis, m.
    """

    turn: Float[np.ndarray, "3 3"]
    middle: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "2"]


def poses_from_outlines(
    seen: Sequence[SeenEllipses],
    model: ObjectModel,
    options: RoundOptions = DEFAULT_ROUND_OPTIONS,
) -> tuple[Float[np.ndarray, "poses 4 4"], Float[np.ndarray, "poses 2"]]:
    """Return world_from_object of a part without edges at all ellipses, and the lengths on edges.

    The lengths are as in `poses_from_circles`, but of its outline.
    """
    outline = OutlineSamples.of(model, options.samples / (np.pi * model.extent))
    if outline is None:
        return np.zeros((0, 4, 4)), np.zeros((0, 2))
    hulls, poses = seen_hulls(model, options.viewpoints), [np.zeros((0, 4, 4))]
    for picture in seen:
        world_from_camera = np.linalg.inv(picture.camera_from_world)
        for conic in picture.conics:
            proposed = _poses_at(conic, picture.plane.focal_length, hulls, options)
            poses.append(
                world_from_camera @ proposed[distinct_poses(model, proposed, options.per_ellipse)]
            )
    proposed = np.concatenate(poses)
    lengths = [supported_lengths(picture, proposed, outline.seen_from, options) for picture in seen]
    return proposed, np.sum(lengths, axis=0)


def seen_hulls(model: ObjectModel, viewpoints: int) -> list[SeenHull]:
    """Return the convex hull of a model as seen from afar, from so many directions."""
    hulls = []
    corners = model.vertices[ConvexHull(model.vertices).vertices]
    for towards in spiral_directions(1.0 - 2.0 * (np.arange(viewpoints) + 0.5) / viewpoints):
        # Any axes across serve; the picture's x, y and the line of sight are right-handed.
        across = np.linalg.svd(towards[None])[2][1]
        frame = np.stack([across, np.cross(-towards, across), -towards])
        flat = corners @ frame.T
        middle, moments = _area_moments(flat[ConvexHull(flat[:, :2]).vertices, :2])
        values, vectors = np.linalg.eigh(moments)
        long, short = vectors[:, 1], np.array([-vectors[1, 1], vectors[0, 1]])
        turn = np.eye(3)
        turn[:2, :2] = np.stack([long, short])
        place = np.append(middle, 0.5 * (flat[:, 2].min() + flat[:, 2].max()))
        # An ellipse with the half axes a, b has the central moments a^2 / 4, b^2 / 4.
        axes = 2.0 * np.sqrt(values[::-1])
        hulls.append(SeenHull(turn @ frame, frame.T @ place, axes))
    return hulls


def _area_moments(
    corners: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """Return the middle of a polygon's area, and its second moments about it, over the area."""
    following = np.roll(corners, -1, axis=0)
    # Of the triangles with the origin: twice the area, and the integral of p p^T.
    doubled = corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]
    area = 0.5 * doubled.sum()
    both = corners + following
    middle = doubled @ both / (6.0 * area)
    sums = np.einsum("n,ni,nj->ij", doubled, both, both)
    sums += np.einsum("n,ni,nj->ij", doubled, corners, corners)
    sums += np.einsum("n,ni,nj->ij", doubled, following, following)
    return middle, sums / (24.0 * area) - np.outer(middle, middle)


def _poses_at(
    conic: Float[np.ndarray, "3 3"],
    focal_length: float,
    hulls: Sequence[SeenHull],
    options: RoundOptions,
) -> Float[np.ndarray, "poses 4 4"]:
    """Return the poses in the camera's frame at which a hull is seen as an ellipse."""
    # The cone of rays, in a frame whose z axis is the ray to the ellipse's middle.
    middle = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    ray = np.append(middle / focal_length, 1.0)
    ray /= np.linalg.norm(ray)
    across = np.linalg.svd(ray[None])[2][1]
    camera_from_ray = np.column_stack([across, np.cross(ray, across), ray])
    to_plane = np.diag([focal_length, focal_length, 1.0]) @ camera_from_ray
    cone = to_plane.T @ conic @ to_plane
    centre = -np.linalg.solve(cone[:2, :2], cone[:2, 2])
    # (p - c)^T M (p - c) = k
    size = cone[:2, 2] @ np.linalg.solve(cone[:2, :2], cone[:2, 2]) - cone[2, 2]
    values, vectors = np.linalg.eigh(cone[:2, :2] / size)
    if not (values > 0.0).all():
        return np.zeros((0, 4, 4))
    long, short = 1.0 / np.sqrt(values)
    angle = np.arctan2(vectors[1, 0], vectors[0, 0])
    poses = [np.zeros((0, 4, 4))]
    for hull in hulls:
        ratio = hull.axes[1] / hull.axes[0]
        if abs(ratio - short / long) > options.ratio_tolerance:
            continue
        distance = np.sqrt(hull.axes.prod() / (long * short))
        count = options.round_turns if ratio > options.round_ratio else 2
        for turn in angle + 2.0 * np.pi * np.arange(count) / count:
            about_ray = host_exponentials(np.array([0.0, 0.0, 0.0, 0.0, 0.0, turn]))[:3, :3]
            rotation = camera_from_ray @ about_ray @ hull.turn
            seen_at = camera_from_ray @ (distance * np.append(centre, 1.0))
            poses.append(host_poses(rotation, seen_at - rotation @ hull.middle)[None])
    return np.concatenate(poses)
