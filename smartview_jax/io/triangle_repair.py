"""Repair what is commonly wrong with the triangles of a mesh file.

STL gives every triangle its own vertices. Programs write triangles twice, with the corners of some
in the other order, or all of them inside out. None of this changes the solid that is meant, but
each adds edges that the object does not have, or turns the normals by which grasps and views are
chosen.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..modeling import winding_number

WELD_DISTANCE = 1e-6
"""Largest distance between vertices that are merged, relative to the object's extent."""

SINGLE_PRECISION = float(np.finfo(np.float32).eps)
"""Largest relative rounding of coordinates in single precision, as in STL, PLY and glTF."""

MIN_RELATIVE_AREA = 1e-12
"""Area of a triangle over the squared extent of the mesh, up to which it has no normal."""


class RepairedTriangles(NamedTuple):
    """Triangles without faults of the file, and what was wrong.

    Attributes:
        vertices: as given; those that were merged into others are not used.
        triangles: counter-clockwise as seen from outside.
        notes: sentences on the repairs, and on faults that are left.
    """

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "T 3"]
    notes: tuple[str, ...]


def repaired_triangles(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "T 3"]
) -> RepairedTriangles:
    """Return triangles with common vertices, each given once, all counter-clockwise from outside.

    A closed surface inside another one is a cavity: its normals point into it. An open surface
    keeps the side that most of its triangles have.

    Args:
        vertices: m.
        triangles: in any order of their corners.

    Raises:
        ValueError: there are no triangles with an area, a coordinate is not finite, or a triangle
            has a vertex that does not exist.
    """
    if not len(triangles):
        raise ValueError("the mesh has no triangles")
    if not np.isfinite(vertices).all():
        raise ValueError("the mesh has coordinates that are not finite")
    # A negative index would silently count from the end.
    wrong = triangles[((triangles < 0) | (triangles >= len(vertices))).any(axis=1)]
    if len(wrong):
        raise ValueError(
            f"a triangle has the vertices {wrong[0].tolist()}, but the mesh has {len(vertices)}, "
            "numbered from 0"
        )
    used = vertices[np.unique(triangles)]
    extent = float(np.ptp(used, axis=0).max())
    joined = _welded(vertices, extent, float(np.abs(used).max()))[triangles]
    whole = joined[_areas(vertices[joined]) > MIN_RELATIVE_AREA * extent**2]
    if not len(whole):
        raise ValueError("the mesh has no triangles with an area")
    # The same three corners in any order.
    _, first = np.unique(np.sort(whole, axis=1), axis=0, return_index=True)
    single = whole[np.sort(first)]
    is_turned = _turned(vertices, single)
    oriented = np.where(is_turned[:, None], single[:, ::-1], single)
    notes = []
    if len(single) < len(whole):
        notes.append(f"{len(whole) - len(single)} triangles that were given twice are left out")
    if is_turned.any():
        notes.append(
            f"{is_turned.sum()} of {len(single)} triangles are turned over, so that all normals "
            "point outward"
        )
    open_count = int((_sides(oriented)[2] == 1).sum())
    if open_count:
        notes.append(f"the surface is open: {open_count} sides of triangles have no neighbour")
    return RepairedTriangles(vertices, oriented, tuple(notes))


def _welded(
    vertices: Float[np.ndarray, "V 3"], extent: float, largest: float
) -> Int[np.ndarray, "V"]:
    """Return for each vertex the first one in its place.

    Args:
        vertices: m.
        extent: of the mesh, m.
        largest: largest coordinate, m. Far from the origin single precision keeps fewer digits.
    """
    from scipy.spatial import KDTree

    radius = max(WELD_DISTANCE * extent, 2.0 * SINGLE_PRECISION * largest)
    # Each cluster is replaced by its first vertex. Rounding would separate neighbours at its steps.
    pairs = KDTree(vertices).query_pairs(radius, output_type="ndarray")
    labels = connected_parts(pairs, len(vertices))
    first = np.full(len(vertices), len(vertices))
    np.minimum.at(first, labels, np.arange(len(vertices)))
    return first[labels]


def _areas(corners: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T"]:
    """Return the areas of triangles, m^2."""
    a, b, c = corners.swapaxes(0, 1)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def connected_parts(pairs: Int[np.ndarray, "pairs 2"], count: int) -> Int[np.ndarray, "nodes"]:
    """Return the number of the connected part of each node of a graph, given its edges."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _sides(
    triangles: Int[np.ndarray, "T 3"],
) -> tuple[Bool[np.ndarray, "S"], Int[np.ndarray, "S"], Int[np.ndarray, "S"]]:
    """Return the three sides of all triangles: their direction, their line, and the line's sides.

    The direction is whether the side begins at the vertex of the smaller number; sides between the
    same two vertices are one line.
    """
    pairs = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    _, line, counts = np.unique(
        np.sort(pairs, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    line = line.ravel()
    return pairs[:, 0] < pairs[:, 1], line, counts[line]


def _turned(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "T 3"]
) -> Bool[np.ndarray, "T"]:
    """Return which triangles have to be turned over."""
    parts, is_turned = _consistent(triangles)
    corners = vertices[np.where(is_turned[:, None], triangles[:, ::-1], triangles)]
    is_open = np.zeros(parts.max() + 1, bool)
    np.logical_or.at(is_open, parts, (_sides(triangles)[2] != 2).reshape(-1, 3).any(axis=1))
    centred = corners - vertices[triangles[0, 0]]
    volumes = np.einsum("ti,ti->t", centred[:, 0], np.cross(centred[:, 1], centred[:, 2])) / 6.0
    of_part = np.bincount(parts, volumes)
    closed = np.flatnonzero(~is_open)
    surfaces = {part: corners[parts == part] for part in closed}
    for part in closed:
        is_cavity = _surfaces_around(surfaces, part) % 2 == 1
        if (of_part[part] < 0.0) != is_cavity:
            is_turned[parts == part] ^= True
    return is_turned


def _surfaces_around(surfaces: dict[int, Float[np.ndarray, "_ 3 3"]], part: int) -> int:
    """Return how many other closed surfaces enclose one of them."""
    inner = surfaces[part].reshape(-1, 3)
    low, high = inner.min(axis=0), inner.max(axis=0)
    count = 0
    for other, outer in surfaces.items():
        # Boxes rule out nearly all pairs.
        around = (outer.min(axis=(0, 1)) < low).all() and (outer.max(axis=(0, 1)) > high).all()
        count += other != part and around and abs(winding_number(outer, inner[0])) > 0.5
    return count


def _consistent(
    triangles: Int[np.ndarray, "T 3"],
) -> tuple[Int[np.ndarray, "T"], Bool[np.ndarray, "T"]]:
    """Return the connected part of each triangle, and which ones differ from most of their part.

    Neighbours run through their common side in opposite directions. Lines with more than two sides,
    where solids touch, connect nothing.
    """
    count = len(triangles)
    is_forward, line, sides_of_line = _sides(triangles)
    shared = np.flatnonzero(sides_of_line == 2)
    first, second = shared[np.argsort(line[shared], kind="stable")].reshape(-1, 2).T
    a, b = first // 3, second // 3
    parts = connected_parts(np.column_stack([a, b]), count)
    # Each triangle is two nodes, as given and turned over; those that agree are connected.
    differ = is_forward[first] == is_forward[second]
    other = b + count * differ
    nodes = np.concatenate(
        [np.column_stack([a, other]), np.column_stack([a + count, (other + count) % (2 * count)])]
    )
    sheets = connected_parts(nodes, 2 * count)
    # The first triangle's sheet; a surface of one side, such as Moebius' strip, has a single one.
    reference = np.full(parts.max() + 1, count)
    np.minimum.at(reference, parts, np.arange(count))
    is_turned = sheets[:count] != sheets[reference[parts]]
    turned_share = np.bincount(parts, is_turned) / np.bincount(parts)
    return parts, is_turned ^ (turned_share > 0.5)[parts]
