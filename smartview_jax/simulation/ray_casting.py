"""Find what rays hit first among triangle meshes, with Embree.

The optional packages trimesh and embreex are needed: `pip install smartview-jax[objects]`.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..extras import import_extra

MISSED = -1
"""Index of the triangle for a ray that hits nothing."""

START_OFFSET = 1e-6
"""Distance from a surface, over the size of the scene, at which a shadow's ray starts.

Rays that start on a triangle would hit it; Embree computes in single precision.
"""


class Hits(NamedTuple):
    """The first points that rays hit.

    Attributes:
        triangle: index of the triangle, `MISSED` where the ray hits nothing.
        points: in the meshes' frame, m; zero where nothing is hit.
        normals: unit normals of the triangles, on the side of the ray's origin.
    """

    triangle: Int[np.ndarray, "rays"]
    points: Float[np.ndarray, "rays 3"]
    normals: Float[np.ndarray, "rays 3"]


class RayCaster:
    """Triangles prepared for ray casting."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        triangles: Int[np.ndarray, "triangles 3"],
    ):
        """Prepare the triangles.

        Args:
            vertices: m.
            triangles: indices of the vertices.

        Raises:
            ImportError: trimesh or embreex is not installed.
            ValueError: no triangles, indices beyond the vertices, vertices that are not finite, or
                triangles without area.
        """
        corners = _corners(vertices, triangles)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
        size = float(np.ptp(vertices, axis=0).max())
        if not (areas > 1e-14 * size**2).all():
            raise ValueError(f"triangles: triangle {int(np.argmin(areas))} has no area")
        self._first_corners = corners[:, 0]
        self._normals = normals / areas[:, None]
        self._start_offset = START_OFFSET * size
        self._intersector = _embree_intersector(vertices, triangles)

    def first_hits(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "rays 3"]
    ) -> Hits:
        """Return the first hits of rays from one point, m; no direction may be zero."""
        origins = np.broadcast_to(origin, directions.shape)
        triangle = np.asarray(self._intersector.intersects_first(origins, directions), dtype=int)
        # The point is computed in double precision from the triangle's plane, n (o + t d - p) = 0:
        # Embree's is off by some 1e-7 of the scene.
        hit = triangle != MISSED
        normals = np.where(hit[:, None], self._normals[triangle], 0.0)
        towards = np.einsum("ij,ij->i", normals, directions)
        gap = np.einsum("ij,ij->i", normals, self._first_corners[triangle] - origin)
        hit &= towards != 0.0
        distance = np.where(hit, gap / np.where(hit, towards, 1.0), 0.0)
        points = np.where(hit[:, None], origin + distance[:, None] * directions, 0.0)
        facing = np.where(towards > 0.0, -1.0, 1.0)[:, None] * normals
        return Hits(np.where(hit, triangle, MISSED), points, facing)

    def is_hidden(
        self,
        points: Float[np.ndarray, "points 3"],
        normals: Float[np.ndarray, "points 3"],
        direction: Float[np.ndarray, "3"],
    ) -> Bool[np.ndarray, "points"]:
        """Return whether anything lies between surface points (m) and a distant light.

        The unit normals are on the side to be lit; the direction is towards the light.
        """
        starts = points + self._start_offset * normals
        directions = np.broadcast_to(direction, points.shape)
        return np.asarray(self._intersector.intersects_any(starts, directions), dtype=bool)


def _corners(vertices: np.ndarray, triangles: np.ndarray) -> Float[np.ndarray, "triangles 3 3"]:
    """Return the corners of triangles; raise a ValueError for arrays that are not a mesh."""
    if not len(triangles):
        raise ValueError("triangles: expected at least one, found none")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        wrong = triangles.max() if triangles.min() >= 0 else triangles.min()
        raise ValueError(f"triangles: index {wrong} among {len(vertices)} vertices")
    if not np.isfinite(vertices).all():
        wrong = int(np.nonzero(~np.isfinite(vertices).all(axis=1))[0][0])
        raise ValueError(f"vertices: vertex {wrong} is not finite")
    return vertices[triangles]


def _embree_intersector(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    """Return trimesh's interface to Embree for the triangles."""
    trimesh, _, embree = (
        import_extra(module, "objects", "a picture of solid objects")
        for module in ("trimesh", "embreex", "trimesh.ray.ray_pyembree")
    )
    # `process=False` keeps the order of the triangles, which identifies hits.
    return embree.RayMeshIntersector(trimesh.Trimesh(vertices, triangles, process=False))
