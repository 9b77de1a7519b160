"""Join the short chords of round rims into arcs, so that an arc is measured like one edge.

A mesh draws a circle as a polygon. A chord of some pixels is too short to be measured, and lies
next to other chords; an arc is as long as an edge, and its distance from the picture's edge changes
linearly along it, as the distance of a straight edge does.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ...modeling import ObjectModel, rim_vertices

MAX_ARC_TURN = float(np.deg2rad(45.0))
"""Largest turn of an arc, rad: distance and tilt describe how it is off, up to 0.03 of its turn."""


class Curves(NamedTuple):
    """The straight edges and the arcs of a model, in the order of their first edges.

    Attributes:
        curve: of each edge.
        chain: rim that each edge belongs to, of arcs that continue one another.
        begin, end: the part of its curve that each edge is, from 0 to 1.
        lengths: of the curves, m.
    """

    curve: Int[np.ndarray, "E"]
    chain: Int[np.ndarray, "E"]
    begin: Float[np.ndarray, "E"]
    end: Float[np.ndarray, "E"]
    lengths: Float[np.ndarray, "C"]

    @classmethod
    def of(cls, model: ObjectModel) -> "Curves":
        """Return the curves of a model; each edge is one where the model has no round rims."""
        count = len(model.edges)
        starts, ends = model.vertices[model.edges].transpose(1, 0, 2)
        lengths = np.linalg.norm(ends - starts, axis=1)
        arcs, chain = list[list[int]](), np.zeros(count, int)
        for number, edges in enumerate(_chains(model)):
            chain[edges] = number
            arcs += _arcs(model, edges)
        curve, begin, end = np.zeros(count, int), np.zeros(count), np.ones(count)
        arcs.sort(key=min)
        for number, edges in enumerate(arcs):
            curve[edges] = number
            if len(edges) > 1:
                borders = np.append(0.0, np.cumsum(lengths[edges])) / lengths[edges].sum()
                begin[edges], end[edges] = borders[:-1], borders[1:]
        return cls(curve, chain, begin, end, np.array([lengths[edges].sum() for edges in arcs]))

    def places(
        self, owners: Int[np.ndarray, "S"], places: Float[np.ndarray, "S"]
    ) -> tuple[Int[np.ndarray, "S"], Float[np.ndarray, "S"]]:
        """Return the edges of places on curves, and the places on these edges, from 0 to 1."""
        # The edges sorted along their curves: place 0.3 of curve 2 is at 2.3.
        order = np.argsort(self.curve + self.begin, kind="stable")
        at = np.searchsorted((self.curve + self.begin)[order], owners + places, side="right") - 1
        edges = order[at]
        return edges, (places - self.begin[edges]) / (self.end - self.begin)[edges]


def is_round(model: ObjectModel) -> bool:
    """Return whether all edges of a model that show are round rims: it has no corners."""
    on_edges = set(model.edges.ravel().tolist())
    return bool(on_edges) and on_edges == set(rim_vertices(model))


def is_smooth(model: ObjectModel) -> bool:
    """Return whether a model has faces but no edges: only its outline shows."""
    return not len(model.edges) and bool(len(model.faces))


def closed_rims(model: ObjectModel) -> list[Int[np.ndarray, "_"]]:
    """Return the vertices of the rims that close."""
    closed = []
    for edges in _chains(model):
        counts = np.bincount(model.edges[edges].ravel())
        if len(edges) > 2 and (counts[counts > 0] == 2).all():
            closed.append(np.flatnonzero(counts))
    return closed


def on_arcs(
    model: ObjectModel, edges: Int[np.ndarray, "S"], places: Float[np.ndarray, "S"]
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"] | None]:
    """Return the points at places of edges, from 0 to 1, m, the tangents, and the curvatures.

    On rims they are on the arc that the edge stands for, a cubic whose tangent at a vertex is
    across the bisector of both edges, as a circle's is.

    Returns:
        points, m; unit tangents; and the vectors to the centre of curvature over the squared
        radius, 1/m, or None for a model without rims.
    """
    pairs = model.edges[edges]
    starts, ends = model.vertices[pairs].transpose(1, 0, 2)
    along = ends - starts
    lengths = np.linalg.norm(along, axis=1, keepdims=True)
    t, tangents = places[:, None], along / lengths
    points = starts + t * along
    rims = rim_vertices(model)
    if not rims:
        return points, tangents, None
    first, last = (_rim_tangents(model, rims, pairs, tangents, end) for end in (0, 1))
    # How far the tangents are from the chord: Hermite's cubic, over the chord.
    u, v = lengths * (first - tangents), lengths * (last - tangents)
    points = points + t * (1.0 - t) ** 2 * u - t**2 * (1.0 - t) * v
    slopes = along + (1.0 - t) * (1.0 - 3.0 * t) * u - t * (2.0 - 3.0 * t) * v
    bends = (6.0 * t - 4.0) * u + (6.0 * t - 2.0) * v
    speed = np.linalg.norm(slopes, axis=1, keepdims=True)
    return points, slopes / speed, bends / speed**2


def _rim_tangents(
    model: ObjectModel,
    rims: dict[int, list[int]],
    pairs: Int[np.ndarray, "S 2"],
    directions: Float[np.ndarray, "S 3"],
    end: int,
) -> Float[np.ndarray, "S 3"]:
    """Return the unit tangents at one end of edges; the edges' own where no rim goes on."""
    tangents = directions.copy()
    for k, pair in enumerate(pairs.tolist()):
        vertex = pair[end]
        if vertex not in rims:
            continue
        (beyond,) = (n for n in rims[vertex] if n != pair[1 - end])
        other = model.vertices[vertex] - model.vertices[beyond]
        other = other if end == 0 else -other
        mean = directions[k] + other / np.linalg.norm(other)
        tangents[k] = mean / np.linalg.norm(mean)
    return tangents


def _chains(model: ObjectModel) -> list[list[int]]:
    """Return the edges of each rim, in their order; an edge of no rim is alone."""
    rims = rim_vertices(model)
    edge_of = {frozenset(pair): k for k, pair in enumerate(model.edges.tolist())}
    free, chains = set(range(len(model.edges))), list[list[int]]()
    for first in range(len(model.edges)):
        if first not in free:
            continue
        a, b = model.edges[first].tolist()
        free.discard(first)
        after = _followed(rims, edge_of, free, a, b)
        before = _followed(rims, edge_of, free, b, a)
        chains.append([*before[::-1], first, *after])
    return chains


def _followed(
    rims: dict[int, list[int]],
    edge_of: dict[frozenset[int], int],
    free: set[int],
    vertex: int,
    following: int,
) -> list[int]:
    """Return the free edges of a rim from the edge between two vertices on, and take them."""
    edges = list[int]()
    while following in rims:
        (beyond,) = (k for k in rims[following] if k != vertex)
        edge = edge_of[frozenset((following, beyond))]
        if edge not in free:
            break
        free.discard(edge)
        edges.append(edge)
        vertex, following = following, beyond
    return edges


def _arcs(model: ObjectModel, edges: list[int]) -> list[list[int]]:
    """Return a rim cut into arcs of equal turns."""
    a, b = model.vertices[model.edges[edges]].transpose(1, 0, 2)
    along = b - a
    cosines = np.abs((along[1:] * along[:-1]).sum(axis=1))
    sines = np.linalg.norm(np.cross(along[1:], along[:-1]), axis=1)
    # The directions of the edges differ in sign only: a rim bends by far less than a quarter turn.
    turns = np.append(0.0, np.cumsum(np.arctan2(sines, cosines)))
    count = max(1, int(np.ceil(turns[-1] / MAX_ARC_TURN)))
    # An arc of a whole turn and one of half an edge less are cut alike.
    number = np.minimum((turns / max(turns[-1], 1e-12) * count).astype(int), count - 1)
    return [[edges[k] for k in np.flatnonzero(number == arc)] for arc in range(count)]
