"""Predict what a camera sees of a model at a pose: vertices, edges, what hides them, and where.

The faces of the model hide what is behind them. Whatever else hides it is not predicted. All
functions work on one pose, under `jit`, `grad` and `vmap`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..cameras import Camera
from .wireframe import Wireframe


class PredictedView(NamedTuple):
    """The wireframe as a camera sees it; what is not visible still has its place where it has one.

    Attributes:
        vertices: pixels; NaN behind the camera or beyond its lens.
        vertex_visible: in front of the camera, within the picture, and not hidden by the model.
        samples: pixels of the points along the edges; NaN likewise.
        directions: unit directions of the edges in the picture at the samples; zero where they have
            none.
        sample_visible: see `vertex_visible`.
        sample_px: length in the picture of the part of the edge that each sample stands for, px,
            visible or not; zero for samples that were added.
        edge_px: visible length of each edge, px.
    """

    vertices: Float[Array, "V 2"]
    vertex_visible: Bool[Array, "V"]
    samples: Float[Array, "S 2"]
    directions: Float[Array, "S 2"]
    sample_visible: Bool[Array, "S"]
    sample_px: Float[Array, "S"]
    edge_px: Float[Array, "E"]


def predict_view(
    wireframe: Wireframe, camera: Camera, camera_from_object: Float[Array, "4 4"]
) -> PredictedView:
    """Return what a camera sees of a wireframe.

    An edge between two faces that look away is hidden, whatever is in front of it; a model without
    faces hides nothing.

    Args:
        wireframe: of the model.
        camera: intrinsics and lens.
        camera_from_object: pose of the object in the camera's frame.
    """
    R, t = camera_from_object[:3, :3], camera_from_object[:3, 3]
    # The camera's centre in the object's frame: c = -R^T t.
    centre = -R.T @ t
    vertices = camera.project(_moved(wireframe.vertices, R, t))[0]
    samples, slopes = jax.jvp(
        lambda points: camera.project(_moved(points, R, t))[0],
        (wireframe.samples,),
        (wireframe.sample_tangents,),
    )
    # Pixels per metre along the edge; derivatives of pixels that are not valid may be anything.
    usable = jnp.isfinite(samples).all(axis=1) & jnp.isfinite(slopes).all(axis=1)
    slopes = jnp.where(usable[:, None], slopes, 0.0)
    scale = _norm(slopes)
    directions = slopes / jnp.where(scale > 0.0, scale, 1.0)[:, None]
    vertex_visible = wireframe.vertex_mask & ~hidden_vertices(wireframe, centre)
    sample_visible = (wireframe.sample_lengths > 0.0) & ~hidden_samples(wireframe, centre)
    # Beyond the lens there is no pixel, and at its limit no derivative.
    sample_visible = sample_visible & usable & within_picture(samples, camera)
    # To first order in the part's length; the parts of an edge are short against its distance.
    sample_px = scale * wireframe.sample_lengths
    edge_px = jnp.zeros(len(wireframe.edges)).at[wireframe.sample_edges]
    return PredictedView(
        vertices,
        vertex_visible & within_picture(vertices, camera),
        samples,
        directions,
        sample_visible,
        sample_px,
        edge_px.add(jnp.where(sample_visible, sample_px, 0.0)),
    )


def hidden_samples(wireframe: Wireframe, centre: Float[Array, "3"]) -> Bool[Array, "S"]:
    """Return which samples of the edges the model's own faces hide from a point.

    Args:
        wireframe: of the model.
        centre: the camera's centre in the object's frame, m.
    """
    own = wireframe.edge_faces[wireframe.sample_edges]
    return _hidden(wireframe, centre, wireframe.samples, own)


def hidden_vertices(wireframe: Wireframe, centre: Float[Array, "3"]) -> Bool[Array, "V"]:
    """Return which vertices the model's own faces hide from a point; as `hidden_samples`."""
    return _hidden(wireframe, centre, wireframe.vertices, wireframe.vertex_faces)


def _hidden(
    wireframe: Wireframe,
    centre: Float[Array, "3"],
    points: Float[Array, "n 3"],
    own: Bool[Array, "n F"],
) -> Bool[Array, "n"]:
    """Return which points are hidden, with the faces to which each belongs."""
    # The point itself is at 1 of its ray; what is nearer to it than the margin does not count.
    reach = _norm(points - centre[None])
    last = 1.0 - wireframe.margin / jnp.maximum(reach, wireframe.margin)
    before = faces_before(wireframe.triangles, wireframe.triangle_faces, centre, points, last)
    # A face does not hide its own border.
    covered = (before & ~own).any(axis=1)
    return covered | _turned_away(wireframe, centre, own)


def edges_turned_away(wireframe: Wireframe, centre: Float[Array, "3"]) -> Bool[Array, "E"]:
    """Return which edges are between faces that all look away from a point; as `hidden_samples`.

    They are all hidden edges of a convex object, at a tenth of the time.
    """
    return _turned_away(wireframe, centre, wireframe.edge_faces)


def _turned_away(
    wireframe: Wireframe, centre: Float[Array, "3"], own: Bool[Array, "n F"]
) -> Bool[Array, "n"]:
    """Return for which points none of the faces to which each belongs is seen from its outside."""
    # n . (c - p) > 0
    towards = ((centre[None] - wireframe.face_points) * wireframe.face_normals).sum(axis=1)
    # One face alone may be a sheet that is seen from both sides.
    return (own.sum(axis=1) >= 2) & ~(own & (towards > 0.0)[None]).any(axis=1)


def faces_before(
    triangles: Float[Array, "T 3 3"],
    triangle_faces: Bool[Array, "T F"],
    centre: Float[Array, "3"],
    points: Float[Array, "n 3"],
    last: Float[Array, "n"],
) -> Bool[Array, "n F"]:
    """Return which faces the rays from a centre to points pass through before they arrive.

    Args:
        triangles: of the faces, as fans of a `Wireframe`.
        triangle_faces: which face each triangle is part of.
        centre: the camera's centre, in the same frame.
        points: at which the rays arrive.
        last: part of each ray, from the centre to its point, within which faces count.
    """
    crossings = triangle_crossings(triangles, centre, points, last)
    # How often a ray winds through each face: triangles of opposite sign cancel.
    return jnp.abs(crossings @ triangle_faces.astype(crossings.dtype)) > 0.5


def triangle_crossings(
    triangles: Float[Array, "T 3 3"],
    centre: Float[Array, "3"],
    points: Float[Array, "n 3"],
    last: Float[Array, "n"],
) -> Float[Array, "n T"]:
    """Return where rays from a centre pass through triangles: 1 or -1 by the side, 0 elsewhere.

    Reference: Moeller and Trumbore, Fast, minimum storage ray-triangle intersection, 1997.

    Args:
        triangles: corners; nothing passes through one without area.
        centre, points, last: as in `faces_before`.
    """
    # With the ray c + t d, d = p - c, and the triangle v0, e1, e2:  c - v0 = -t d + u e1 + v e2.
    # By Cramer's rule, with s = c - v0, all four determinants are products of d or e2 with vectors
    # that are common to all rays:
    #     det = d . (e2 x e1),  det u = d . (e2 x s),  det v = d . (s x e1),  det t = e2 . (s x e1).
    v0, e1, e2 = (triangles[:, k] for k in range(3))
    e1, e2, s = e1 - v0, e2 - v0, centre[None] - v0
    d = points - centre[None]
    det = d @ jnp.cross(e2, e1).T
    det_u, det_v = d @ jnp.cross(e2, s).T, d @ jnp.cross(s, e1).T
    det_t = (e2 * jnp.cross(s, e1)).sum(axis=1)[None]
    # All are compared after multiplication with det's sign: triangles without area have det = 0.
    sign, size = jnp.sign(det), jnp.abs(det)
    u, v, t = sign * det_u, sign * det_v, sign * det_t
    # A ray along the border of two triangles passes through both rather than between them.
    slack = 1e-9 * size
    passed = (u >= -slack) & (v >= -slack) & (u + v <= size + slack)
    passed = passed & (t > 0.0) & (t < last[:, None] * size)
    return jnp.where(passed, sign, 0.0)


def search_regions(
    points: Float[Array, "n 3"],
    camera: Camera,
    camera_from_object: Float[Array, "4 4"],
    pose_covariance: Float[Array, "6 6"],
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 2"]]:
    """Return the pixels of points of an object, and their covariances due to that of its pose.

    Args:
        points: in the object's frame, m.
        camera: intrinsics and lens.
        camera_from_object: pose of the object in the camera's frame.
        pose_covariance: of the tangent at the object, translation first: the true pose is
            `camera_from_object @ SE3.exp(tangent)`.

    Returns:
        pixels, and covariances in px^2; NaN behind the camera or beyond its lens.
    """
    pixels, J = pose_jacobians(points, camera, camera_from_object)
    return pixels, J @ pose_covariance[None] @ jnp.swapaxes(J, 1, 2)


def pose_jacobians(
    points: Float[Array, "n 3"], camera: Camera, camera_from_object: Float[Array, "4 4"]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 6"]]:
    """Return the pixels of points of an object, and their derivatives by the object's pose.

    The six columns belong to the tangent at the object, translation first; arguments as in
    `search_regions`.
    """
    R, t = camera_from_object[:3, :3], camera_from_object[:3, 3]
    # p_camera = R (p + v + w x p) + t to first order in the tangent (v, w).
    axes = jnp.broadcast_to(jnp.eye(3)[None], (len(points), 3, 3))
    turns = jnp.cross(axes, points[:, None, :])
    moves = jnp.concatenate([axes, turns], axis=1) @ R.T

    def project(points_in_camera: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
        return camera.project(points_in_camera)[0]

    in_camera = _moved(points, R, t)
    columns = [jax.jvp(project, (in_camera,), (moves[:, k],)) for k in range(6)]
    return columns[0][0], jnp.stack([column for _, column in columns], axis=-1)


def _moved(
    points: Float[Array, "n 3"], R: Float[Array, "3 3"], t: Float[Array, "3"]
) -> Float[Array, "n 3"]:
    """Return points in the target's frame, R p + t."""
    return points @ R.T + t[None]


def _norm(vectors: Float[Array, "n k"]) -> Float[Array, "n"]:
    """Return the lengths of vectors; the derivative of a zero length is zero, not NaN."""
    squared = (vectors**2).sum(axis=1)
    positive = squared > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def within_picture(pixels: Float[Array, "n 2"], camera: Camera) -> Bool[Array, "n"]:
    """Return which pixels are within the picture; NaN is not."""
    size = jnp.asarray(camera.image_size, dtype=pixels.dtype)[None]
    return ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1)
