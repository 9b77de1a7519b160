"""Keep a coarse depth map of each picture: whatever is behind a known surface is hidden.

Accepted objects hide parts of others, as neighbours in a bin do. Their faces are drawn into coarse
maps of inverse depth, in which any point of any model can be looked up.
"""

import copy

import numpy as np
from jaxtyping import Bool, Float

from ..cameras import Camera
from ..features import IdealPlane
from ..geometry import host_transformed
from ..modeling import SeenViews
from .edge_lookup import DEPTH_CELL_PX
from .wireframe import Wireframe

MIN_DEPTH = 1e-3
"""Smallest depth of a drawn face, m; faces that reach behind the camera are left out."""


class DepthBuffers:
    """The inverse depth of the nearest known surface in each cell of every picture.

    Attributes:
        inverse_depth: 1 / depth along the optical axis, 1/m; zero where no surface is known.
    """

    def __init__(self, views: SeenViews):
        self._views = views
        self._columns, self._rows = (-(-size // DEPTH_CELL_PX) for size in views.largest_picture)
        count = len(views.camera_from_world)
        self.inverse_depth: Float[np.ndarray, "views rows columns"] = np.zeros(
            (count, self._rows, self._columns)
        )
        self._rays: list[Float[np.ndarray, "rows columns 2"]] = []

    def copy(self) -> "DepthBuffers":
        """Return a copy to which surfaces can be added; both share the grids of rays."""
        # Compute the grids before copying: they take longer than drawing an object.
        self._ray_grids()
        other = copy.copy(self)
        other.inverse_depth = self.inverse_depth.copy()
        return other

    def add(self, wireframe: Wireframe, world_from_object: Float[np.ndarray, "4 4"]) -> None:
        """Draw the faces of an object into the maps of all views."""
        vertices, corners = np.asarray(wireframe.vertices), np.asarray(wireframe.triangle_vertices)
        in_world = host_transformed(world_from_object, vertices)
        for is_on_face in np.asarray(wireframe.triangle_faces).T:
            if is_on_face.any():
                self._draw(in_world[corners[is_on_face]])

    def add_triangles(self, triangles: Float[np.ndarray, "T 3 3"]) -> None:
        """Draw triangles in the world into the maps of all views."""
        for triangle in triangles:
            self._draw(triangle[None])

    def _draw(self, triangles: Float[np.ndarray, "T 3 3"]) -> None:
        """Draw a face in the world, given as a triangle fan."""
        grids = self._ray_grids()
        for view, camera_from_world in enumerate(self._views.camera_from_world):
            in_camera = host_transformed(camera_from_world, triangles)
            if in_camera[..., 2].min() < MIN_DEPTH:
                continue
            corners, rays = in_camera[..., :2] / in_camera[..., 2:], grids[view]
            low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
            # Outside the lens's field of view rays are NaN, and comparisons with NaN are false.
            places = np.nonzero(((rays >= low) & (rays <= high)).all(axis=2))
            inside_box = rays[places]
            # Triangles of opposite orientation cancel where a face is not convex.
            inside = np.stack([_is_inside(inside_box, triangle) for triangle in corners], axis=1)
            first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            turns = np.sign(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
            covered = np.abs(inside @ turns)
            # Where the plane n . p = n . a meets the ray (x, y, 1):  1 / z = n . (x, y, 1) / n . a
            a = in_camera[0, 0]
            normals = np.cross(in_camera[:, 1] - a, in_camera[:, 2] - a)
            # Some triangles of a fan have no area.
            normal = normals[np.argmax((normals**2).sum(axis=1))]
            across = float(normal @ a)
            if across == 0.0:
                continue
            inverse = np.where(covered > 0.5, (inside_box @ normal[:2] + normal[2]) / across, 0.0)
            maps = self.inverse_depth[view]
            maps[places] = np.maximum(maps[places], inverse)

    def _ray_grids(self) -> list[Float[np.ndarray, "rows columns 2"]]:
        """Return `(x / z, y / z)` of the rays through the centres of all cells, for each view."""
        # Views of one camera share its grid; all are computed when the first object is drawn.
        if not self._rays:
            cameras = self._views.cameras
            distinct = {id(camera): camera for camera in cameras}
            grid_of = {key: self._ray_grid(camera) for key, camera in distinct.items()}
            self._rays = [grid_of[id(camera)] for camera in cameras]
        return self._rays

    def _ray_grid(self, camera: Camera) -> Float[np.ndarray, "rows columns 2"]:
        """Return the grid of one camera."""
        plane = IdealPlane(camera)
        v, u = np.mgrid[: self._rows, : self._columns] * DEPTH_CELL_PX
        middles = np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5 * (DEPTH_CELL_PX - 1)
        ideal = plane.from_pixels(middles) / plane.focal_length
        return ideal.reshape(self._rows, self._columns, 2)


def checked_triangles(
    triangles: Float[np.ndarray, "triangles 3 3"] | None,
) -> Float[np.ndarray, "triangles 3 3"]:
    """Return the given triangles, or an empty array for None; raise a ValueError if invalid."""
    array = np.zeros((0, 3, 3)) if triangles is None else np.asarray(triangles, dtype=float)
    if array.ndim != 3 or array.shape[1:] != (3, 3) or not np.isfinite(array).all():
        raise ValueError(
            f"occluders: expected finite triangles, (triangles, 3, 3); found {array.shape}"
        )
    return array


def _is_inside(
    points: Float[np.ndarray, "n 2"], triangle: Float[np.ndarray, "3 2"]
) -> Bool[np.ndarray, "n"]:
    """Return which points of a plane are inside a triangle of any orientation."""
    ends = np.roll(triangle, -1, axis=0)
    side, gap = ends - triangle, points[:, None] - triangle
    turns = side[:, 0] * gap[..., 1] - side[:, 1] * gap[..., 0]
    return np.logical_or((turns >= 0.0).all(axis=1), (turns <= 0.0).all(axis=1))
