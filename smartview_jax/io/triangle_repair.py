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
    """Return triangles with common vertices (m), each given once, counter-clockwise from outside.

    A closed surface inside another one is a cavity: its normals point into it. An open surface
    keeps the side that most of its triangles have.
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
    whole = joined[(joined != np.roll(joined, 1, axis=1)).all(axis=1)]
    # The same three corners in any order.
    _, first = np.unique(np.sort(whole, axis=1), axis=0, return_index=True)
    single = whole[np.sort(first)]
    has_area = _areas(vertices[single]) > MIN_RELATIVE_AREA * extent**2
    if not has_area.any():
        raise ValueError("the mesh has no triangles with an area")
    # A triangle without an area may join its neighbours, where a vertex is within a side.
    everything = np.ones(len(single), bool)
    kept = min((has_area, everything), key=lambda chosen: _open_sides(single[chosen]))
    connected, has_area = single[kept], has_area[kept]
    is_turned = _turned(vertices, connected)
    oriented = np.where(is_turned[:, None], connected[:, ::-1], connected)[has_area]
    notes = []
    if repeated := len(whole) - len(single):
        notes.append(f"triangles that repeat others and are left out: {repeated}")
    if turned := int(is_turned[has_area].sum()):
        notes.append(
            f"{turned} of {len(oriented)} triangles are turned over, so that normals point outward"
        )
    if open_sides := _open_sides(connected):
        notes.append(f"the surface is open: {open_sides} sides of triangles have no neighbour")
    return RepairedTriangles(vertices, oriented, tuple(notes))


def _welded(
    vertices: Float[np.ndarray, "V 3"], extent: float, largest: float
) -> Int[np.ndarray, "V"]:
    """Return for each vertex the first one in its place, with the precision of the coordinates.

    The farther the mesh is from the origin, the fewer digits single precision keeps.
    """
    from scipy.spatial import KDTree

    radius = max(WELD_DISTANCE * extent, 2.0 * SINGLE_PRECISION * largest)
    # Equal vertices are joined first: all pairs of the thousands in the middle of a disc would take
    # gigabytes. Rounding alone would separate neighbours at its steps.
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    pairs = KDTree(places).query_pairs(radius, output_type="ndarray")
    labels = connected_parts(pairs, len(places))[place.ravel()]
    # Each cluster is replaced by its first vertex.
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
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    # One number for each pair of vertices: NumPy sorts numbers much faster than rows.
    pair = np.minimum(start, end) * (triangles.max() + 1) + np.maximum(start, end)
    _, line, counts = np.unique(pair, return_inverse=True, return_counts=True)
    return start < end, line, counts[line]


def _open_sides(triangles: Int[np.ndarray, "T 3"]) -> int:
    """Return the number of sides of triangles at which no other triangle begins."""
    return int((_sides(triangles)[2] == 1).sum())


def _turned(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "T 3"]
) -> Bool[np.ndarray, "T"]:
    """Return which triangles have to be turned over."""
    parts, is_turned = _consistent(triangles)
    corners = vertices[np.where(is_turned[:, None], triangles[:, ::-1], triangles)]
    centred = corners - vertices[triangles[0, 0]]
    volumes = np.einsum("ti,ti->t", centred[:, 0], np.cross(centred[:, 1], centred[:, 2])) / 6.0
    is_inward = np.bincount(parts, volumes) < 0.0
    is_closed = _closed(triangles, parts)
    is_cavity = _surfaces_around(corners, parts, is_closed) % 2 == 1
    return is_turned ^ (is_closed & (is_inward != is_cavity))[parts]


def _closed(
    triangles: Int[np.ndarray, "T 3"], parts: Int[np.ndarray, "T"]
) -> Bool[np.ndarray, "parts"]:
    """Return which connected parts of a surface have no border."""
    _, line, _ = _sides(triangles)
    # By part, since the line where two solids touch has two sides of each.
    lines = line.max() + 1
    own, counts = np.unique(np.repeat(parts, 3) * lines + line, return_counts=True)
    return np.bincount(own // lines, counts % 2) == 0


def _surfaces_around(
    corners: Float[np.ndarray, "T 3 3"],
    parts: Int[np.ndarray, "T"],
    is_closed: Bool[np.ndarray, "parts"],
) -> Int[np.ndarray, "parts"]:
    """Return by how many other closed parts each closed part is enclosed; zero for open ones."""
    low, high = np.full((len(is_closed), 3), np.inf), np.full((len(is_closed), 3), -np.inf)
    np.minimum.at(low, parts, corners.min(axis=1))
    np.maximum.at(high, parts, corners.max(axis=1))
    counts = np.zeros(len(is_closed), int)
    for part in np.flatnonzero(is_closed):
        # Boxes rule out nearly all pairs.
        is_around = is_closed & (low < low[part]).all(axis=1) & (high > high[part]).all(axis=1)
        point = corners[np.argmax(parts == part), 0]
        surfaces = (corners[parts == other] for other in np.flatnonzero(is_around))
        counts[part] = sum(abs(winding_number(surface, point)) > 0.5 for surface in surfaces)
    return counts


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
