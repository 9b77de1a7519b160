"""Tell edges that something hides from edges that are not there, by how they end in the pictures.

A pose at the corner of another block has its edges explained exactly as far as that block reaches,
and nothing behind. What would hide the rest is not known, but leaves traces:

- where an edge disappears behind something, the outline of that thing runs across it, straight, and
  on both sides (a T-junction; Waltz, "Understanding line drawings of scenes with shadows", 1975);
- what stands before an edge cuts it off at another place in each view. An edge that breaks off at
  one place of the model in two views ends there itself;
- an edge that is the object's does not go on beyond its vertex.

Each end has its likelihood if the object is there, and if it is another one, from how often such
ends were counted in both cases.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..features import EdgePoints
from .edge_lines import EdgeLines
from .wireframe import Wireframe

DROPOUT_PX, MIN_PIECE_PX, MIN_GAP_PX = 4.0, 8.0, 12.0
"""Lengths on an edge, px: a shorter gap within what is found is noise, a shorter piece is not of
this edge, and what is missing after that counts from the last one."""

SAME_PLACE_PX = 5.0
"""Largest distance along an edge between its ends in two views that are at one place, px."""

BESIDE = 4
"""Number of samples on both sides of an end that another view has to show to tell of it."""

LEVER = 8
"""Number of samples over which the direction of an edge at its end is taken."""

CROSSING_ANGLES = np.deg2rad(np.arange(25.0, 156.0, 6.0))
"""Directions, from the edge's own, of the outlines that may cross it."""

CROSSING_OFFSETS = np.arange(-6.0, 10.0)
"""Places along the edge, from its end, px, where an outline may cross it."""

CROSSING_REACH = (3, 14)
"""Distances from the crossing, px, between which an outline has to be seen on both sides.

Nearer to the junction the smoothed pictures show none of the two edges."""

CROSSING_SHARE = 0.65
"""Part of that length, on the side with less of it, that has edge points of a crossing outline."""

CROSSING_DISTANCE, CROSSING_ALIGNMENT = 1.2, 0.9
"""Largest distance of edge points from a straight outline, px, and smallest cosine of normals."""

BEYOND_REACH, BEYOND_SHARE = (4, 20), 0.7
"""Distances beyond a vertex, px, and the part of them with edge points of an edge that goes on."""

BEYOND_DISTANCE, BEYOND_ALIGNMENT = 1.5, 0.95
"""Largest distance of such points from the edge's line, px, and smallest cosine of normals."""

LOG_RATIOS = {
    ("same", False): -2.2,
    ("same", True): -1.0,
    ("other", False): 0.1,
    ("other", True): 1.6,
    ("unknown", False): -0.5,
    ("unknown", True): 1.0,
}
"""Log-likelihood ratios of an end by its place in another view and whether an outline crosses it.

Place and crossing are nearly independent, so that the ratios of both are added; where no other view
shows the place, that of the crossing alone counts. Of 216 ends in 23 partly hidden solids, and of
207 in 33 boxes "seen" at the corners of other blocks, 5 and 36 % of those that two views show were
at the same place, 47 and 14 % were crossed.
"""

LOG_RATIO_BEYOND, LOG_RATIO_VERTEX = -0.8, 0.04
"""Likewise of an edge that is found up to its vertex: of one that goes on there, and of others.

It did at 3 % of the vertices of those solids, and at 8 % of those of the boxes."""


class Piece(NamedTuple):
    """A part of an edge in a view.

    Attributes:
        kind: 1 where edge points are found, 0 where they are missing, -1 where it is not visible.
        first, last: its first sample among those of the edge, and the one behind its last.
        length: visible length, px.
    """

    kind: int
    first: int
    last: int
    length: float


class EdgeEnd(NamedTuple):
    """A place where what is found of an edge breaks off.

    Attributes:
        view, edge: indices.
        sample: last one that is found, among those of the edge.
        sense: 1 if the samples that follow are missing, -1 if those before are.
        is_crossed: whether the outline of something runs across it.
        place: "same" or "other" than in another view; "unknown" where none shows this place.
    """

    view: int
    edge: int
    sample: int
    sense: int
    is_crossed: bool
    place: str

    @property
    def log_ratio(self) -> float:
        """The log-likelihood if something hides the rest, over that if there is none."""
        # Two ends at one place are one observation.
        weight = 0.5 if self.place == "same" else 1.0
        return weight * LOG_RATIOS[self.place, self.is_crossed]


class EdgeInViews:
    """The samples of an edge in all views, and the pieces that are found of it.

    Attributes:
        edge: its index.
        px: visible length that each sample stands for, (views, samples), px.
        pixels: where they are in the pictures, (views, samples, 2), px.
        visible: which of them are visible at all.
        pieces: of each view.
    """

    def __init__(self, lines: EdgeLines, samples: Int[np.ndarray, "n"], edge: int):
        self.edge = edge
        self.px = np.asarray(lines.sample_px)[:, samples]
        self.pixels = np.asarray(lines.samples)[:, samples]
        found = np.isfinite(lines.distances[:, samples])
        self.visible = self.px > 0.0
        self.pieces = [
            pieces_of(np.where(seen, own.astype(int), -1), px)
            for seen, own, px in zip(self.visible, found, self.px, strict=True)
        ]

    def direction(self, view: int, sample: int, sense: int, piece: Piece) -> np.ndarray:
        """Return the unit direction in which an edge leads out of a piece, in the picture."""
        inner = np.clip(sample - sense * LEVER, piece.first, piece.last - 1)
        along = self.pixels[view, sample] - self.pixels[view, inner]
        return along / max(float(np.linalg.norm(along)), 1e-9)

    def breaks(self, view: int) -> list[tuple[int, int, Piece]]:
        """Return sample, sense and piece of each place where what is found gives way to nothing."""
        found, own = [], self.pieces[view]
        for before, after in pairwise(own):
            if (before.kind, after.kind) == (1, 0):
                found.append((before.last - 1, 1, before))
            elif (before.kind, after.kind) == (0, 1):
                found.append((after.first, -1, after))
        return found

    def vertices(self, view: int) -> list[tuple[int, int, Piece]]:
        """Return likewise the ends of the edge itself up to which it is found."""
        found, own = [], self.pieces[view]
        if own[0].kind == 1:
            found.append((0, -1, own[0]))
        if own[-1].kind == 1:
            found.append((own[-1].last - 1, 1, own[-1]))
        return found

    def place(self, view: int, sample: int, sense: int) -> str:
        """Return whether another view has an end at the place of one: see `EdgeEnd`."""
        place = "unknown"
        for other in set(range(len(self.px))) - {view}:
            near = slice(max(sample - BESIDE, 0), sample + BESIDE + 1)
            if not self.visible[other, near].all():
                continue
            for at, towards, _ in self.breaks(other):
                between = slice(min(at, sample), max(at, sample))
                apart = 0.5 * float(self.px[[view, other], between].sum())
                if towards == sense and apart <= SAME_PLACE_PX:
                    return "same"
            place = "other"
        return place


def pieces_of(kinds: Int[np.ndarray, "n"], px: Float[np.ndarray, "n"]) -> list[Piece]:
    """Return the pieces of an edge, given the kind and the visible length of each sample."""
    starts = np.flatnonzero(np.diff(kinds, prepend=-2))
    stops = np.append(starts[1:], len(kinds))
    pieces = [
        Piece(int(kinds[a]), int(a), int(b), float(px[a:b].sum()))
        for a, b in zip(starts, stops, strict=True)
    ]
    for kind, shortest in ((0, DROPOUT_PX), (1, MIN_PIECE_PX), (0, MIN_GAP_PX)):
        joined: list[Piece] = []
        for one in pieces:
            # What is too short is of the other kind.
            if one.kind == kind and one.length < shortest:
                one = one._replace(kind=1 - kind)
            if joined and joined[-1].kind == one.kind:
                before = joined.pop()
                one = Piece(one.kind, before.first, one.last, before.length + one.length)
            joined.append(one)
        pieces = joined
    return pieces


def edges_in_views(lines: EdgeLines, wireframe: Wireframe) -> list[EdgeInViews]:
    """Return the edges of a model that were looked for in some view."""
    owners, lengths = np.asarray(wireframe.sample_edges), np.asarray(wireframe.sample_lengths)
    edges = np.flatnonzero((lines.visible_px > 0.0).any(axis=0))
    own = [np.flatnonzero((owners == edge) & (lengths > 0.0)) for edge in edges]
    return [EdgeInViews(lines, one, int(edge)) for one, edge in zip(own, edges, strict=True)]


def edge_ends(edges: Sequence[EdgeInViews], pictures: Sequence[EdgePoints]) -> list[EdgeEnd]:
    """Return where what is found of the edges breaks off.

    Args:
        edges: in all views.
        pictures: all edge points of each view, also those that another object explains.
    """
    ends = []
    for edge in edges:
        for view, points in enumerate(pictures):
            for sample, sense, piece in edge.breaks(view):
                out = edge.direction(view, sample, sense, piece)
                crossed = is_crossed(points, edge.pixels[view, sample], out)
                place = edge.place(view, sample, sense)
                ends.append(EdgeEnd(view, edge.edge, sample, sense, crossed, place))
    return ends


def log_likelihood_of_ends(
    lines: EdgeLines, wireframe: Wireframe, pictures: Sequence[EdgePoints]
) -> float:
    """Return the log-likelihood of how edges end, over that at the corner of another solid.

    Args:
        lines: of the pose.
        wireframe: of the model.
        pictures: all edge points of each view.
    """
    edges = edges_in_views(lines, wireframe)
    total = sum(end.log_ratio for end in edge_ends(edges, pictures))
    for edge in edges:
        for view, points in enumerate(pictures):
            for sample, sense, piece in edge.vertices(view):
                out = edge.direction(view, sample, sense, piece)
                beyond = goes_on(points, edge.pixels[view, sample], out)
                total += LOG_RATIO_BEYOND if beyond else LOG_RATIO_VERTEX
    return float(total)


def is_crossed(
    points: EdgePoints, end: Float[np.ndarray, "2"], out: Float[np.ndarray, "2"]
) -> bool:
    """Return whether a straight outline runs across an edge at its end, on both sides of it.

    Args:
        points: of the picture.
        end: the last point of the edge, px.
        out: its unit direction there, towards what is missing.
    """
    low, high = CROSSING_REACH
    p, g = _seen_from(points, end, out, high - CROSSING_OFFSETS[0])
    u = np.stack([np.cos(CROSSING_ANGLES), np.sin(CROSSING_ANGLES)])
    n = np.stack([-u[1], u[0]])
    # Of every point its distance from each line, and its place along it; (points, angles, offsets).
    offsets = CROSSING_OFFSETS[None, None]
    across = (p @ n)[..., None] - offsets * n[0][None, :, None]
    along = (p @ u)[..., None] - offsets * u[0][None, :, None]
    near = (np.abs(across) <= CROSSING_DISTANCE) & (np.abs(along) < high)
    near &= (np.abs(g @ n) >= CROSSING_ALIGNMENT)[..., None]
    # Each pixel along a line counts once, however many points it has.
    _, angle, offset = np.nonzero(near)
    pixel = np.floor(along[near]).astype(int) + high
    seen = np.zeros((len(CROSSING_ANGLES), len(CROSSING_OFFSETS), 2 * high), dtype=bool)
    seen[angle, offset, pixel] = True
    sides = seen[..., high + low :].sum(axis=2), seen[..., : high - low].sum(axis=2)
    return bool(np.minimum(*sides).max() >= CROSSING_SHARE * (high - low))


def goes_on(points: EdgePoints, end: Float[np.ndarray, "2"], out: Float[np.ndarray, "2"]) -> bool:
    """Return whether an edge goes on, straight, beyond its end; the arguments of `is_crossed`."""
    low, high = BEYOND_REACH
    p, g = _seen_from(points, end, out, float(high))
    own = (np.abs(g[:, 1]) >= BEYOND_ALIGNMENT) & (np.abs(p[:, 1]) <= BEYOND_DISTANCE)
    own &= (p[:, 0] >= low) & (p[:, 0] < high)
    return len(np.unique(np.floor(p[own, 0]))) >= BEYOND_SHARE * (high - low)


def _seen_from(
    points: EdgePoints, end: Float[np.ndarray, "2"], out: Float[np.ndarray, "2"], reach: float
) -> tuple[Float[np.ndarray, "near 2"], Float[np.ndarray, "near 2"]]:
    """Return the edge points about an end, and their normals, along and across its direction."""
    gap = points.pixels - end
    near = (np.abs(gap) <= reach).all(axis=1)
    axes = np.stack([out, [-out[1], out[0]]], axis=1)
    return gap[near] @ axes, points.normals[near] @ axes
