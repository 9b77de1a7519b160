"""Index pictures by pixel: their edge points, and the depth of the nearest known surface.

A program looks edge points up along a line. Accepted objects hide parts of others, as neighbours in
a bin do: their faces are drawn into coarse maps of inverse depth, in which any point of any model
can be looked up.
"""

import copy
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...argument_checks import MAX_COORDINATE
from ...cameras import Camera
from ...features import MIN_GRADIENT_SIGMA, SMOOTHED_LENGTH, EdgePoints, IdealPlane, lone_points
from ...geometry import host_transformed
from ...modeling import SeenViews
from ...runtime.array_namespace import to_device
from ...runtime.padding import power_of_two_from, repeat_last
from .wireframe import Wireframe

MIN_EDGE_POINTS = 32_768
"""Smallest size that edge points are padded to; above it the next power of two is taken."""

DEPTH_CELL_PX = 4
"""Side of the cells of the depth map, px."""

FAR_AWAY = -1e6
"""Coordinate, px, of the padded edge point that stands for "none"."""


class EdgeLookup(eqx.Module):
    """The edge points of all pictures, and the index of the edge point in each pixel.

    Views are padded to a power of two with pictures that have no edge points. The last point of
    each view is far away and stands for "none".

    Attributes:
        cells: index of the edge point in each pixel. A chain of edge points may pass between
            diagonal neighbours; the four neighbours of each point hold its index too, unless they
            have their own point.
        pixels: sub-pixel positions, px.
        normals: unit directions of the gradient.
        strengths: magnitudes of the gradient, grey levels per px.
        lone: whether no other edge of the picture is near enough to displace the point.
        nearest: inverse depth of the nearest known surface in each cell, 1/m; zero where none is
            known.
        valid: False for padded views.
        correlated_lengths: length of an edge whose points count as one observation, px.
        gradient_sigmas: standard deviation of the gradient's noise, grey levels per px.
    """

    cells: Int[Array, "views rows columns"]
    pixels: Float[Array, "views points 2"]
    normals: Float[Array, "views points 2"]
    strengths: Float[Array, "views points"]
    lone: Bool[Array, "views points"]
    nearest: Float[Array, "views depth_rows depth_columns"]
    valid: Bool[Array, "views"]
    correlated_lengths: Float[Array, "views"]
    gradient_sigmas: Float[Array, "views"]

    @classmethod
    def of(
        cls,
        pictures: Sequence[EdgePoints],
        image_size: tuple[int, int],
        usable: Sequence[Bool[np.ndarray, "_"]] | None = None,
        inverse_depth: Float[np.ndarray, "_ depth_rows depth_columns"] | None = None,
        lone: Sequence[Bool[np.ndarray, "_"]] | None = None,
        correlated_lengths: Sequence[float] | None = None,
        gradient_sigmas: Sequence[float] | None = None,
    ) -> "EdgeLookup":
        """Return the lookup of the edge points of pictures.

        Args:
            pictures: edge points of each view.
            image_size: width and height, px.
            usable: for each view, which points may be used; all by default.
            inverse_depth: of the nearest known surfaces (`DepthBuffers`), 1/m; none by default.
            lone: for each view, which points no other edge displaces; computed by default.
            correlated_lengths: of each view, px; by default as smoothing makes them.
            gradient_sigmas: of each view, grey levels per px; by default of a picture without
                noise, but for its rounding.
        """
        views, largest = padded_view_count(len(pictures)), max(len(p.pixels) for p in pictures)
        # One more than there are points: the last stands for "none".
        count = power_of_two_from(int(largest) + 1, MIN_EDGE_POINTS)
        cells = np.full((views, image_size[1], image_size[0]), count - 1, dtype=np.int32)
        pixels = np.full((views, count, 2), FAR_AWAY)
        normals, strengths = np.zeros((views, count, 2)), np.zeros((views, count))
        is_lone = np.zeros((views, count), dtype=bool)
        for view, points in enumerate(pictures):
            indices = np.arange(len(points.pixels), dtype=np.int32)
            chosen = indices if usable is None else indices[usable[view]]
            _write_cells(cells[view], points.cells[chosen], chosen)
            pixels[view, indices], normals[view, indices] = points.pixels, points.normals
            strengths[view, indices] = points.strengths
            is_lone[view, indices] = lone_points(points) if lone is None else lone[view]
        nearest = np.zeros((views, *(-(-size // DEPTH_CELL_PX) for size in image_size[::-1])))
        if inverse_depth is not None:
            nearest[: len(pictures)] = inverse_depth
        valid = np.arange(views) < len(pictures)
        lengths, sigmas = np.full(views, SMOOTHED_LENGTH), np.full(views, MIN_GRADIENT_SIGMA)
        if correlated_lengths is not None:
            lengths[: len(pictures)] = correlated_lengths
        if gradient_sigmas is not None:
            sigmas[: len(pictures)] = gradient_sigmas
        arrays = cells, pixels, normals, strengths, is_lone, nearest, valid, lengths, sigmas
        return cls(*map(to_device, arrays))


def padded_view_count(count: int) -> int:
    """Return the number of views that programs are compiled for: a power of two, at least two."""
    return power_of_two_from(count, 2)


def padded_poses(poses: Float[np.ndarray, "views 4 4"]) -> Float[np.ndarray, "padded 4 4"]:
    """Return poses with the last one repeated up to `padded_view_count`."""
    return repeat_last(poses, padded_view_count(len(poses)))


def _write_cells(
    cells: Int[np.ndarray, "rows columns"],
    places: Int[np.ndarray, "points 2"],
    indices: Int[np.ndarray, "points"],
) -> None:
    """Write indices into the pixels of points and, unless taken, into the four neighbours."""
    rows, columns = cells.shape
    # The points' own pixels are written last, so that no neighbour takes them.
    for du, dv in ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)):
        u = np.clip(places[:, 0] + du, 0, columns - 1)
        v = np.clip(places[:, 1] + dv, 0, rows - 1)
        cells[v, u] = indices


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
    farthest = np.abs(array).max(initial=0.0)
    if farthest > MAX_COORDINATE:
        raise ValueError(
            f"occluders: expected metres, up to {MAX_COORDINATE:g} m from the origin; found "
            f"{farthest:.4g}"
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
