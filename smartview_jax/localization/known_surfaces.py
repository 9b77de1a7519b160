"""Keep the nearest known surface in each part of every picture: what is behind it is hidden.

Objects that were accepted hide parts of others, as neighbours in a bin do. Their faces are drawn
into coarse maps of inverse depth, in which a program looks up any point of any model.
"""

import numpy as np
from jaxtyping import Bool, Float

from ..features import IdealPlane
from ..modeling import SeenViews
from .edge_lookup import KNOWN_CELL_PX
from .wireframe import Wireframe

MIN_DEPTH = 1e-3
"""Smallest depth of a drawn surface, m: what reaches behind the camera is left out."""


class KnownSurfaces:
    """The nearest known surface in each part of every picture.

    Attributes:
        inverse_depth: one over the depth along the optical axis, 1/m; zero where nothing is known.
    """

    def __init__(self, views: SeenViews):
        self._views = views
        width, height = views.camera.image_size
        self._columns, self._rows = (-(-size // KNOWN_CELL_PX) for size in (width, height))
        count = len(views.camera_from_world)
        self.inverse_depth: Float[np.ndarray, "views rows columns"] = np.zeros(
            (count, self._rows, self._columns)
        )
        self._rays: Float[np.ndarray, "rows columns 2"] | None = None

    def add(self, wireframe: Wireframe, world_from_object: Float[np.ndarray, "4 4"]) -> None:
        """Draw the faces of an object into the maps of all views."""
        triangles = np.asarray(wireframe.triangles)
        used = np.asarray(wireframe.triangle_faces).any(axis=1)
        signs = np.asarray(wireframe.triangle_faces)[used]
        corners = np.concatenate([triangles[used], np.ones((used.sum(), 3, 1))], axis=2)
        for view, camera_from_world in enumerate(self._views.camera_from_world):
            in_camera = corners @ (camera_from_world @ world_from_object).T
            if len(in_camera) and in_camera[..., 2].min() > MIN_DEPTH:
                self._draw(self.inverse_depth[view], in_camera[..., :3], signs)

    def _draw(
        self,
        inverse_depth: Float[np.ndarray, "rows columns"],
        triangles: Float[np.ndarray, "T 3 3"],
        signs: Float[np.ndarray, "T F"],
    ) -> None:
        """Draw faces in the camera's frame, given as triangles with their signs in each face."""
        corners = triangles[..., :2] / triangles[..., 2:]
        rays = self._ray_grid()
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        # Beyond the lens a ray is NaN, which no comparison finds inside.
        places = np.nonzero(((rays >= low) & (rays <= high)).all(axis=2))
        own = rays[places]
        inside = np.stack([_is_inside(own, triangle) for triangle in corners], axis=1)
        # Triangles of opposite sign cancel where a face is not convex.
        in_face = np.abs(inside @ signs) > 0.5
        nearest = inverse_depth[places]
        for face in np.flatnonzero(np.abs(signs).any(axis=0)):
            a, b, c = triangles[np.argmax(np.abs(signs[:, face]))]
            # Where the plane n . p = n . a meets the ray (x, y, 1):  1 / z = n . (x, y, 1) / n . a
            normal = np.cross(b - a, c - a)
            across = float(normal @ a)
            if across == 0.0:
                continue
            inverse = (own @ normal[:2] + normal[2]) / across
            nearest = np.where(in_face[:, face], np.maximum(nearest, inverse), nearest)
        inverse_depth[places] = nearest

    def _ray_grid(self) -> Float[np.ndarray, "rows columns 2"]:
        """Return `(x / z, y / z)` of the rays through the middles of all cells."""
        # The views have one camera; the grid is made when the first object is drawn.
        if self._rays is None:
            plane = IdealPlane(self._views.camera)
            v, u = np.mgrid[: self._rows, : self._columns] * KNOWN_CELL_PX
            middles = np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5 * (KNOWN_CELL_PX - 1)
            ideal = plane.from_pixels(middles) / plane.focal_length
            self._rays = ideal.reshape(self._rows, self._columns, 2)
        return self._rays


def _is_inside(
    points: Float[np.ndarray, "n 2"], triangle: Float[np.ndarray, "3 2"]
) -> Bool[np.ndarray, "n"]:
    """Return which points of a plane are inside a triangle of any orientation."""
    ends = np.roll(triangle, -1, axis=0)
    side, gap = ends - triangle, points[:, None] - triangle
    turns = side[:, 0] * gap[..., 1] - side[:, 1] * gap[..., 0]
    return np.logical_or((turns >= 0.0).all(axis=1), (turns <= 0.0).all(axis=1))
