"""Predict how a camera sees a model at a pose: vertices, edges, and which of them are hidden.

The faces of the model hide what is behind them; occlusion by other objects is not predicted. All
functions work on one pose, under `jit`, `grad` and `vmap`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...cameras import AnyCamera
from ...features import BORDER
from .outlines import with_outline
from .wireframe import Wireframe


class PredictedView(NamedTuple):
    """The wireframe as a camera sees it; hidden points have pixels too, where they project.

    Attributes:
        vertices: pixels; NaN behind the camera or outside the lens's field of view.
        vertex_visible: whether in front of the camera, within the picture, and not hidden by the
            model.
        samples: pixels of the points along the edges; NaN as for vertices.
        directions: unit directions of the edges in the picture at the samples; zero where
            undefined.
        sample_visible: the same, and not at the picture's border, where no edge is measured.
        sample_px: length in the picture of each sample's part of its edge, px, visible or not; zero
            for padded samples.
        edge_px: visible length of each edge, px, without outlines of smooth surfaces.
        bends: curvatures of the edges in the picture, 1/px, towards their centres; None where all
            edges are straight.
    """

    vertices: Float[Array, "V 2"]
    vertex_visible: Bool[Array, "V"]
    samples: Float[Array, "S 2"]
    directions: Float[Array, "S 2"]
    sample_visible: Bool[Array, "S"]
    sample_px: Float[Array, "S"]
    edge_px: Float[Array, "E"]
    bends: Float[Array, "S 2"] | None = None


def predict_view(
    wireframe: Wireframe, camera: AnyCamera, camera_from_object: Float[Array, "4 4"]
) -> PredictedView:
    """Return how a camera sees a wireframe.

    An edge between two faces that face away is hidden; a model without faces hides nothing.

    Args:
        wireframe: of the model.
        camera: intrinsics and lens.
        camera_from_object: pose of the object in the camera's frame.
    """
    R, t = camera_from_object[:3, :3], camera_from_object[:3, 3]
    centre = centre_in_object(camera_from_object)
    wireframe = with_outline(wireframe, centre)
    vertices = camera.project(_moved(wireframe.vertices, R, t))[0]

    def project(points: Float[Array, "S 3"]) -> Float[Array, "S 2"]:
        return camera.project(_moved(points, R, t))[0]

    samples, slopes = jax.jvp(project, (wireframe.samples,), (wireframe.sample_tangents,))
    # Pixels per metre along the edge; derivatives of invalid pixels are undefined.
    usable = jnp.isfinite(samples).all(axis=1) & jnp.isfinite(slopes).all(axis=1)
    slopes = jnp.where(usable[:, None], slopes, 0.0)
    scale = _norm(slopes)
    directions = slopes / jnp.where(scale > 0.0, scale, 1.0)[:, None]
    vertex_visible = wireframe.vertex_mask & ~hidden_vertices(wireframe, centre)
    sample_visible = (wireframe.sample_lengths > 0.0) & ~hidden_samples(wireframe, centre)
    # Outside the lens's field of view there is no pixel, and at its border no derivative.
    sample_visible = sample_visible & usable & within_picture(samples, camera, BORDER)
    # First order in the part's length, which is short compared with the distance.
    sample_px = scale * wireframe.sample_lengths
    edge_px = jnp.zeros(len(wireframe.edges)).at[wireframe.sample_edges]
    bends = None
    if wireframe.sample_bends is not None:
        # That depth changes along an arc adds a share of its size over its distance only.
        bends = jax.jvp(project, (wireframe.samples,), (wireframe.sample_bends,))[1]
        bends = jnp.where(usable[:, None], bends, 0.0)
        bends = bends - (bends * directions).sum(axis=1, keepdims=True) * directions
        bends = bends / jnp.where(scale > 0.0, scale, 1.0)[:, None] ** 2
    return PredictedView(
        vertices,
        vertex_visible & within_picture(vertices, camera),
        samples,
        directions,
        sample_visible,
        sample_px,
        edge_px.add(jnp.where(sample_visible & (wireframe.sample_chains >= 0), sample_px, 0.0)),
        bends,
    )


def centre_in_object(camera_from_object: Float[Array, "4 4"]) -> Float[Array, "3"]:
    """Return the camera's centre in the object's frame, m."""
    # c = -R^T t
    return -camera_from_object[:3, :3].T @ camera_from_object[:3, 3]


def hidden_samples(wireframe: Wireframe, centre: Float[Array, "3"]) -> Bool[Array, "S"]:
    """Return which samples of the edges the model's own faces hide from a viewpoint.

    Args:
        wireframe: of the model.
        centre: the camera's centre in the object's frame, m.
    """
    away = samples_turned_away(wireframe, centre)
    own_faces = wireframe.edge_faces[wireframe.sample_edges]
    return away | _covered(wireframe, centre, wireframe.samples, own_faces)


def samples_turned_away(wireframe: Wireframe, centre: Float[Array, "3"]) -> Bool[Array, "S"]:
    """Return which samples are only between faces that face away; as `hidden_samples`.

    For a convex object these are all hidden samples, at a tenth of the time.
    """
    edges = _turned_away(wireframe, centre, wireframe.edge_faces)
    # An outline is where it starts to turn away.
    return edges[wireframe.sample_edges] & (wireframe.sample_chains >= 0)


def hidden_vertices(wireframe: Wireframe, centre: Float[Array, "3"]) -> Bool[Array, "V"]:
    """Return which vertices the model's own faces hide from a viewpoint; as `hidden_samples`."""
    covered = _covered(wireframe, centre, wireframe.vertices, wireframe.vertex_faces)
    return covered | _turned_away(wireframe, centre, wireframe.vertex_faces)


def _covered(
    wireframe: Wireframe,
    centre: Float[Array, "3"],
    points: Float[Array, "n 3"],
    own_faces: Bool[Array, "n F"],
) -> Bool[Array, "n"]:
    """Return which points are behind faces, given the faces that each belongs to."""
    # The point is at 1 on its ray; faces within the margin before it do not count.
    reach = _norm(points - centre[None])
    last = 1.0 - wireframe.margin / jnp.maximum(reach, wireframe.margin)
    smooth = wireframe.smooth
    if smooth is None:
        before = faces_before(wireframe.triangles, wireframe.triangle_faces, centre, points, last)
        return (before & ~own_faces).any(axis=1)
    # With hundreds of faces it takes too long to ask for each. Within the margin a point's own
    # faces do not count anyway.
    crossings = triangle_crossings(wireframe.triangles, centre, points, last)
    covered = jnp.abs(crossings) @ smooth.lone_triangles.astype(crossings.dtype) > 0.5
    windings = crossings @ smooth.fan_faces.astype(crossings.dtype)
    return covered | (jnp.abs(windings) > 0.5).any(axis=1)


def _turned_away(
    wireframe: Wireframe, centre: Float[Array, "3"], own_faces: Bool[Array, "n F"]
) -> Bool[Array, "n"]:
    """Return for which points none of their faces faces the viewpoint."""
    # n . (c - p) > 0
    towards = ((centre[None] - wireframe.face_points) * wireframe.face_normals).sum(axis=1)
    # A single face may be a sheet that is visible from both sides.
    return (own_faces.sum(axis=1) >= 2) & ~(own_faces & (towards > 0.0)[None]).any(axis=1)


def faces_before(
    triangles: Float[Array, "T 3 3"],
    triangle_faces: Bool[Array, "T F"],
    centre: Float[Array, "3"],
    points: Float[Array, "n 3"],
    last: Float[Array, "n"],
) -> Bool[Array, "n F"]:
    """Return which faces the rays from a centre to points cross before they reach the points.

    Args:
        triangles: of the faces, as fans of a `Wireframe`.
        triangle_faces: the face that each triangle belongs to.
        centre: the camera's centre, in the same frame.
        points: end points of the rays.
        last: fraction of each ray, from the centre, within which faces count.
    """
    crossings = triangle_crossings(triangles, centre, points, last)
    # The winding number of a face about the ray: triangles of opposite sign cancel.
    return jnp.abs(crossings @ triangle_faces.astype(crossings.dtype)) > 0.5


def triangle_crossings(
    triangles: Float[Array, "T 3 3"],
    centre: Float[Array, "3"],
    points: Float[Array, "n 3"],
    last: Float[Array, "n"],
) -> Float[Array, "n T"]:
    """Return how rays from a centre cross triangles: 1 or -1 by the side, 0 for no crossing.

    Reference: Moeller and Trumbore, Fast, minimum storage ray-triangle intersection, 1997.

    Args:
        triangles: corners; no ray crosses one without area.
        centre, points, last: as in `faces_before`.
    """
    # With the ray c + t d, d = p - c, and the triangle v0, e1, e2: c - v0 = -t d + u e1 + v e2. By
    # Cramer's rule, with s = c - v0, all four determinants are products of d or e2 with vectors
    # common to all rays:
    #     det = d . (e2 x e1),  det u = d . (e2 x s),  det v = d . (s x e1),  det t = e2 . (s x e1).
    v0, e1, e2 = (triangles[:, k] for k in range(3))
    e1, e2, s = e1 - v0, e2 - v0, centre[None] - v0
    d = points - centre[None]
    det = d @ jnp.cross(e2, e1).T
    det_u, det_v = d @ jnp.cross(e2, s).T, d @ jnp.cross(s, e1).T
    det_t = (e2 * jnp.cross(s, e1)).sum(axis=1)[None]
    # All are compared after multiplication with det's sign, since triangles without area have det =
    # 0.
    sign, size = jnp.sign(det), jnp.abs(det)
    u, v, t = sign * det_u, sign * det_v, sign * det_t
    # A ray along the border of two triangles counts as crossing both, not neither.
    slack = 1e-9 * size
    passed = (u >= -slack) & (v >= -slack) & (u + v <= size + slack)
    passed = passed & (t > 0.0) & (t < last[:, None] * size)
    return jnp.where(passed, sign, 0.0)


def pose_jacobians(
    points: Float[Array, "n 3"], camera: AnyCamera, camera_from_object: Float[Array, "4 4"]
) -> tuple[Float[Array, "n 2"], Float[Array, "n 2 6"]]:
    """Return the pixels of an object's points, and their derivatives by the object's pose.

    Args:
        points: in the object's frame, m.
        camera: intrinsics and lens.
        camera_from_object: pose of the object in the camera's frame.

    Returns:
        pixels; and their derivatives by the pose's tangent, translation first: the true pose is
        `camera_from_object @ SE3.exp(tangent)`. NaN behind the camera or outside the lens's field
        of view.
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


def within_picture(
    pixels: Float[Array, "n 2"], camera: AnyCamera, border: float = 0.0
) -> Bool[Array, "n"]:
    """Return which pixels are within the picture, without a border of a width, px."""
    size = jnp.asarray(camera.image_size, dtype=pixels.dtype)[None]
    return ((pixels > border - 0.5) & (pixels < size - border - 0.5)).all(axis=1)
