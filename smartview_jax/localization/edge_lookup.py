"""Index the edge points of pictures by pixel, so that a program can look them up along a line."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..features import SMOOTHED_LENGTH, EdgePoints, lone_points
from ..runtime.array_namespace import to_device
from ..runtime.padding import power_of_two_from, repeat_last

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
    """

    cells: Int[Array, "views rows columns"]
    pixels: Float[Array, "views points 2"]
    normals: Float[Array, "views points 2"]
    strengths: Float[Array, "views points"]
    lone: Bool[Array, "views points"]
    nearest: Float[Array, "views depth_rows depth_columns"]
    valid: Bool[Array, "views"]
    correlated_lengths: Float[Array, "views"]

    @classmethod
    def of(
        cls,
        pictures: Sequence[EdgePoints],
        image_size: tuple[int, int],
        usable: Sequence[Bool[np.ndarray, "_"]] | None = None,
        inverse_depth: Float[np.ndarray, "_ depth_rows depth_columns"] | None = None,
        lone: Sequence[Bool[np.ndarray, "_"]] | None = None,
        correlated_lengths: Sequence[float] | None = None,
    ) -> "EdgeLookup":
        """Return the lookup of the edge points of pictures.

        Args:
            pictures: edge points of each view.
            image_size: width and height, px.
            usable: for each view, which points may be used; all by default.
            inverse_depth: of the nearest known surfaces (`DepthBuffers`), 1/m; none by default.
            lone: for each view, which points no other edge displaces; computed by default.
            correlated_lengths: of each view, px; by default as smoothing makes them.
        """
        views, largest = padded_view_count(len(pictures)), max(len(p.pixels) for p in pictures)
        # One more than there are points: the last stands for "none".
        count = max(MIN_EDGE_POINTS, 1 << int(largest).bit_length())
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
        lengths = np.full(views, SMOOTHED_LENGTH)
        if correlated_lengths is not None:
            lengths[: len(pictures)] = correlated_lengths
        arrays = cells, pixels, normals, strengths, is_lone, nearest, valid, lengths
        return cls(*map(to_device, arrays))


def padded_view_count(count: int) -> int:
    """Return the number of views that programs are compiled for: a power of two, at least two."""
    return max(2, power_of_two_from(count))


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
