"""Edge points of wireframes at known poses, drawn instead of found in rendered pictures.

Their noise has the correlation that smoothing gives to neighbouring points.
"""

import functools

import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import ConvexHull, Delaunay
from seen_scene import IMAGE_SIZE

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5
from smartview_jax.features import EdgePoints, Features, PictureEvidence, edge_maps, lone_points
from smartview_jax.geometry import host_matrices, look_at
from smartview_jax.localization import Wireframe, predict_view
from smartview_jax.modeling import SeenViews
from smartview_jax.runtime.compilation import compiled

STEP = 1.0
"""Distance between edge points along an edge, px."""

predicted = compiled(predict_view)


def camera():
    lens = OpenCV5(-0.12, 0.05, 3e-4, -2e-4, 0.0)
    return sv.Camera(1500.0, 1505.0, 325.0, 236.0, lens, IMAGE_SIZE)


def pinhole(alpha_u=1500.0, alpha_v=1505.0):
    """A camera without distortion, whose lens has the numbers that the others have."""
    return sv.Camera(alpha_u, alpha_v, 325.0, 236.0, OpenCV5(0.0, 0.0, 0.0, 0.0, 0.0), IMAGE_SIZE)


def calibration():
    """Tool and camera are one frame, and so are base and world: poses are the camera's."""
    return sv.Calibration.eye_in_hand(camera(), np.eye(4), np.eye(4))


def poses_towards(point, directions, distance=0.4):
    """`base_from_tool` of cameras that look along directions at a point."""
    looking = look_at(jnp.asarray(point), jnp.asarray(directions, dtype=float), distance)
    return np.linalg.inv(host_matrices(looking))


TWO_DIRECTIONS = np.array([[0.5, 0.6, -0.8], [-0.35, 0.75, -0.8]])


def drawn(model, views, world_from_object, sigma=0.1, rng=None, shift=None, hidden=()):
    """Edge points of the visible edges in every view.

    Args:
        shift: px by which all points of each edge are off, drawn with this standard deviation.
        hidden: edges that have no points.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    wireframe = Wireframe.of(model, 1024)
    pictures = []
    for camera, camera_from_world in zip(views.cameras, views.camera_from_world, strict=True):
        view = predicted(wireframe, camera, jnp.asarray(camera_from_world @ world_from_object))
        seen, edges = np.asarray(view.sample_visible), np.asarray(wireframe.sample_edges)
        pixels, normals = [np.zeros((0, 2))], [np.zeros((0, 2))]
        for edge in set(np.unique(edges[seen]).tolist()) - set(hidden):
            own = np.flatnonzero(seen & (edges == edge))
            p, d = np.asarray(view.samples)[own], np.asarray(view.directions)[own]
            length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
            t = np.arange(rng.uniform(0.0, STEP), length[-1], STEP)
            if len(t) < 2:
                continue
            p, d = (np.column_stack([np.interp(t, length, x) for x in y.T]) for y in (p, d))
            n = np.column_stack([-d[:, 1], d[:, 0]])
            # exp(-d^2 / (4 s^2)) is white noise smoothed by s = 1 px, scaled to unit variance.
            noise = gaussian_filter1d(rng.standard_normal(len(t) + 40), 1.0 / STEP)[20:-20]
            noise *= np.sqrt(2.0 * np.sqrt(np.pi) / STEP)
            offset = 0.0 if shift is None else shift * rng.standard_normal()
            pixels.append(p + (sigma * noise + offset)[:, None] * n)
            normals.append(n * rng.choice([-1.0, 1.0]))
        pixels, normals = np.concatenate(pixels), np.concatenate(normals)
        cells = np.round(pixels).astype(int)
        width, rows = camera.image_size
        inside = (cells >= 0).all(axis=1) & (cells < [width, rows]).all(axis=1)
        strengths = np.full(int(inside.sum()), 20.0)
        pictures.append(EdgePoints(pixels[inside], normals[inside], strengths, cells[inside]))
    return pictures


def not_behind(pictures, views, model, world_from_object):
    """The edge points that a convex object, the hull of its vertices, does not cover."""
    vertices = model.vertices @ world_from_object[:3, :3].T + world_from_object[:3, 3]
    kept = []
    for points, camera_from_world in zip(pictures, views.camera_from_world, strict=True):
        in_camera = vertices @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        seen = np.asarray(views.camera.project(jnp.asarray(in_camera))[0])
        outline = Delaunay(seen[ConvexHull(seen).vertices])
        free = outline.find_simplex(points.pixels) < 0
        kept.append(EdgePoints(*(part[free] for part in points)))
    return kept


def seen_views(model_middle, directions=TWO_DIRECTIONS, distance=0.4):
    """The calibration's views of a point."""
    return SeenViews.of(calibration(), poses_towards(model_middle, directions, distance))


@functools.cache
def nothing_found(image_size=IMAGE_SIZE):
    """No features, and the maps of their edges."""
    empty = np.zeros((0, 2))
    features = Features(
        empty, np.zeros((0, 2, 2)), np.zeros((0, 2), int), np.zeros((0, 2, 2)),
        np.zeros((0, 2, 2, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), image_size,
    )  # fmt: skip
    return features, edge_maps(features, camera())


def evidence(pictures, sizes=None):
    """Edge points as evidence; the hypotheses are given, so that nothing else is asked for."""
    sizes = [IMAGE_SIZE] * len(pictures) if sizes is None else sizes
    return [
        PictureEvidence(features, points, lone_points(points), maps)
        for points, (features, maps) in zip(pictures, map(nothing_found, sizes), strict=True)
    ]


def together(*pictures):
    """The edge points of several drawings of the same views, side by side."""
    return [
        EdgePoints(*(np.concatenate(parts) for parts in zip(*one, strict=True)))
        for one in zip(*pictures, strict=True)
    ]
