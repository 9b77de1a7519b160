"""Propose poses of parts without corners from the ellipses in the pictures.

A circle of known radius that is seen as an ellipse is at one of two poses, except for turns about
its axis, which do not matter to a round part. Every rim of the model is tried on every ellipse.

The outline of a ring, a knob or an egg, which have no edges at all, looks like an ellipse from most
viewpoints. Seen from each of many directions the convex hull of the part has two axes, as its
moments say; where an ellipse has axes of the same ratio, their size gives the distance, and their
direction the turn in the picture.

All poses are scored by how much of the rims, or of the outline, lies on edge points of all
pictures.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, KDTree

from ...features import IdealPlane, PictureEvidence, find_ellipses
from ...geometry import host_exponentials, host_poses, spiral_directions
from ...modeling import ObjectModel, SeenViews
from ..distinct_poses import distinct_poses
from ..edges import OutlineSamples, SeenEdges, Wireframe, closed_rims
from .options import DEFAULT_ROUND_OPTIONS, RoundOptions


class SeenEllipses(NamedTuple):
    """The ellipses and the edge points of a picture, in its ideal plane.

    Attributes:
        plane: of the camera.
        points: edge points, px.
        normals: directions of their gradients.
        conics: of the ellipses.
        camera_from_world: extrinsics.
    """

    plane: IdealPlane
    points: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]
    conics: Float[np.ndarray, "ellipses 3 3"]
    camera_from_world: Float[np.ndarray, "4 4"]


class Circle(NamedTuple):
    """A circle in space: its centre, m, a unit normal of its plane, and its radius, m."""

    centre: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    radius: float


def circles_of(model: ObjectModel, options: RoundOptions = DEFAULT_ROUND_OPTIONS) -> list[Circle]:
    """Return the rims of a model that are circles."""
    circles = []
    for loop in closed_rims(model):
        points = model.vertices[loop]
        middle = points.mean(axis=0)
        axes = np.linalg.svd(points - middle)[2]
        flat = (points - middle) @ axes[:2].T
        # |p|^2 = 2 c . p + r^2 - |c|^2
        system = np.column_stack([2.0 * flat, np.ones(len(flat))])
        solution = np.linalg.lstsq(system, (flat**2).sum(axis=1))[0]
        centre = middle + solution[:2] @ axes[:2]
        distances = np.linalg.norm(points - centre, axis=1)
        radius = float(distances.mean())
        if np.abs(distances - radius).max() < options.roundness * radius:
            circles.append(Circle(centre, axes[2], radius))
    return circles


def circle_poses(
    conic: Float[np.ndarray, "3 3"], focal_length: float, radius: float
) -> list[Circle]:
    """Return the two circles of a radius that are seen as an ellipse, in the camera's frame.

    Reference: Chen, Wu and Wada, Camera calibration with two arbitrary coplanar circles, 2004.

    Args:
        conic: of the ellipse, in the ideal plane.
        focal_length: of the ideal plane, px.
        radius: of the circle, m.
    """
    # The cone of rays (x, y, 1): the ellipse is where f times it meets the plane.
    to_plane = np.diag([focal_length, focal_length, 1.0])
    values, vectors = np.linalg.eigh(to_plane.T @ conic @ to_plane)
    # One eigenvalue has the other sign: make it the negative one, in the order a >= b > 0 > c.
    if (values > 0.0).sum() == 1:
        values = -values
    order = np.argsort(-values)
    (a, b, c), axes = values[order], vectors[:, order]
    if not (b > 0.0 > c):
        return []
    across, along = np.sqrt((a - b) / (a - c)), np.sqrt((b - c) / (a - c))
    distance = b * radius / np.sqrt(-a * c)
    circles = []
    for sign in (1.0, -1.0):
        centre = distance * (sign * c / b * across * axes[:, 0] - a / b * along * axes[:, 2])
        normal = sign * across * axes[:, 0] - along * axes[:, 2]
        centre, normal = (centre, normal) if centre[2] > 0.0 else (-centre, -normal)
        circles.append(Circle(centre, normal, radius))
    return circles


def seen_ellipses(
    evidence: Sequence[PictureEvidence],
    views: SeenViews,
    options: RoundOptions = DEFAULT_ROUND_OPTIONS,
) -> list[SeenEllipses]:
    """Return the ellipses in pictures."""
    seen = []
    for picture, camera, camera_from_world in zip(
        evidence, views.cameras, views.camera_from_world, strict=True
    ):
        plane, edge_points = IdealPlane(camera), picture.edge_points
        points, normals = plane.with_normals(edge_points.pixels, edge_points.normals)
        usable = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
        points, normals = points[usable], normals[usable]
        conics = find_ellipses(points, normals, options.ellipses)[: options.max_ellipses]
        seen.append(SeenEllipses(plane, points, normals, conics, camera_from_world))
    return seen


def poses_from_circles(
    seen: Sequence[SeenEllipses],
    model: ObjectModel,
    options: RoundOptions = DEFAULT_ROUND_OPTIONS,
) -> tuple[Float[np.ndarray, "poses 4 4"], Float[np.ndarray, "poses 2"]]:
    """Return world_from_object of a round model at all ellipses, and the lengths on edge points.

    The lengths are of its rims, px: visible, and supported by edge points of all pictures, nearer
    ones counting more.
    """
    rims, poses = circles_of(model, options), [np.zeros((0, 4, 4))]
    for picture in seen:
        world_from_camera = np.linalg.inv(picture.camera_from_world)
        for conic in picture.conics:
            for rim in rims:
                for circle in circle_poses(conic, picture.plane.focal_length, rim.radius):
                    poses.append(world_from_camera @ _poses_of(rim, circle))
    proposed, wireframe = np.concatenate(poses), Wireframe.of(model, options.samples)
    visible_rims = _visible_rims(wireframe)
    lengths = [supported_lengths(picture, proposed, visible_rims, options) for picture in seen]
    return proposed, np.sum(lengths, axis=0)


def _poses_of(rim: Circle, circle: Circle) -> Float[np.ndarray, "2 4 4"]:
    """Return the two poses that put a rim of a model onto a circle, either side up."""
    poses = []
    for normal in (circle.normal, -circle.normal):
        turn = np.cross(rim.normal, normal)
        sine, cosine = float(np.linalg.norm(turn)), float(rim.normal @ normal)
        # Any axis across serves for half a turn.
        across = np.linalg.svd(rim.normal[None])[2][1]
        axis = turn / sine if sine > 1e-9 else across
        tangent = np.concatenate([np.zeros(3), np.arctan2(sine, cosine) * axis])
        rotation = host_exponentials(tangent)[:3, :3]
        poses.append(host_poses(rotation, circle.centre - rotation @ rim.centre))
    return np.stack(poses)


def _visible_rims(wireframe: Wireframe) -> Callable[[Float[np.ndarray, "3"]], SeenEdges]:
    """Return a function of a camera's centre in the object's frame: samples of the rims it sees."""
    # On the host: the programs of `scoring` are for thousands of poses.
    real = np.asarray(wireframe.sample_lengths) > 0.0
    points, tangents, lengths, edges = (
        np.asarray(part)[real]
        for part in (
            wireframe.samples,
            wireframe.sample_tangents,
            wireframe.sample_lengths,
            wireframe.sample_edges,
        )
    )
    faces = np.asarray(wireframe.edge_faces)[edges]
    origins, face_normals = np.asarray(wireframe.face_points), np.asarray(wireframe.face_normals)

    def seen_from(centre: Float[np.ndarray, "3"]) -> SeenEdges:
        # n . (c - p) > 0
        towards = ((centre - origins) * face_normals).sum(axis=1) > 0.0
        shown = (faces & towards).any(axis=1)
        return SeenEdges(points[shown], tangents[shown], lengths[shown])

    return seen_from


def supported_lengths(
    picture: SeenEllipses,
    poses: Float[np.ndarray, "poses 4 4"],
    seen_from: Callable[[Float[np.ndarray, "3"]], SeenEdges],
    options: RoundOptions,
) -> Float[np.ndarray, "poses 2"]:
    """Return the visible and the supported length of an object's edges in a picture, px.

    Args:
        picture: edge points.
        poses: world_from_object.
        seen_from: samples of the edges or the outline that a camera's centre in the object's frame
            sees.
        options: how near and how well aligned an edge point has to be.
    """
    tree, f = KDTree(picture.points), picture.plane.focal_length
    totals = np.zeros((len(poses), 2))
    for k, pose in enumerate(picture.camera_from_world @ poses):
        R, t = pose[:3, :3], pose[:3, 3]
        seen = seen_from(-R.T @ t)
        p, d = seen.points @ R.T + t, seen.tangents @ R.T
        if not len(p) or p[:, 2].min() <= 0.0:
            continue
        ideal = f * p[:, :2] / p[:, 2:]
        # d(x / z) = (dx - x / z dz) / z
        slope = (f * d[:, :2] - ideal * d[:, 2:]) / p[:, 2:]
        scale = np.linalg.norm(slope, axis=1)
        gap, nearest = tree.query(ideal, distance_upper_bound=options.gate)
        is_supported = np.isfinite(gap)
        n = picture.normals[np.where(is_supported, nearest, 0)]
        across = np.abs(n[:, 0] * slope[:, 1] - n[:, 1] * slope[:, 0])
        is_supported &= across > options.min_alignment * scale
        px = scale * seen.lengths
        totals[k] = (
            px.sum(),
            (px * is_supported * (1.0 - np.minimum(gap / options.gate, 1.0) ** 2)).sum(),
        )
    return totals


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
