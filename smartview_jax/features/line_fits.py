"""Fit many straight lines to edge points at once, each along a proposal and beyond its ends.

All proposals go through the same steps together, as flat arrays of members (pairs of a proposal and
a point). A textured picture has thousands of proposals.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from .groups import grouped_indices

BAND_HALF_WIDTHS = (2.5, 1.5, 1.2)
"""Largest distances of edge points from the line, px, in successive fits."""

MAX_EXTENSION = 30.0
"""Length, px, by which a segment may grow in each fit, in addition to doubling."""

MAX_GAP = 4.0
"""Largest distance between neighbouring points of one segment, px."""

MIN_POINTS = 5
"""Smallest number of points of a line."""

MIN_ALIGNMENT = float(np.cos(np.deg2rad(22.5)))
"""Smallest cosine between an edge point's gradient and the line's normal."""

END_MARGIN = 3.0
"""Length at either end of a segment that is left out of the fit, px: other edges bend it there."""

POINTS_PER_CELL = 3
"""Largest number of points stored in one cell of a pixel's size; few have two."""

LOOKUPS_PER_BATCH = 2_000_000
"""Number of cells that are looked up at once, to limit memory."""


class Members(NamedTuple):
    """Points near lines, sorted by line.

    Attributes:
        line: index of the line, ascending.
        point: index of the point.
    """

    line: Int[np.ndarray, "members"]
    point: Int[np.ndarray, "members"]

    def of(self, keep: Bool[np.ndarray, "members"]) -> "Members":
        """Return the selected members."""
        return Members(self.line[keep], self.point[keep])


class CentredLines(NamedTuple):
    """Straight lines of some length.

    Attributes:
        centres: the middle of each line.
        normals: unit normals, from dark to light.
        half_lengths: px.
    """

    centres: Float[np.ndarray, "lines 2"]
    normals: Float[np.ndarray, "lines 2"]
    half_lengths: Float[np.ndarray, "lines"]

    @classmethod
    def between(cls, ends: Float[np.ndarray, "lines 2 2"]) -> "CentredLines":
        """Return the lines between two ends each; the sign of their normals is arbitrary."""
        spans = ends[:, 1] - ends[:, 0]
        lengths = np.linalg.norm(spans, axis=1)
        normals = np.column_stack([-spans[:, 1], spans[:, 0]]) / lengths[:, None]
        return cls(ends.mean(axis=1), normals, 0.5 * lengths)


class LineFits(NamedTuple):
    """Lines, and the points that each of them runs through; none for rejected lines."""

    lines: CentredLines
    members: Members


class PointGrid:
    """Edge points in cells of a pixel's size, to look up the points near a line."""

    def __init__(
        self, points: Float[np.ndarray, "points 2"], normals: Float[np.ndarray, "points 2"]
    ):
        self.points: Float[np.ndarray, "points 2"] = points
        self.normals: Float[np.ndarray, "points 2"] = normals
        cells = np.rint(points).astype(int)
        self._origin = cells.min(axis=0, initial=0)
        self._size = cells.max(axis=0, initial=0) - self._origin + 1
        # Rows of cells, each with places for its points.
        self._strides = np.array([1, self._size[0]])
        flat = (cells - self._origin) @ self._strides
        order = np.argsort(flat, kind="stable")
        first = np.searchsorted(flat[order], flat[order])
        place = np.arange(len(order)) - first
        fits = place < POINTS_PER_CELL
        self._cells = np.full((int(self._size.prod()), POINTS_PER_CELL), -1, dtype=np.int32)
        self._cells[flat[order[fits]], place[fits]] = order[fits]
        # Most cells are empty, and a table of bytes stays in the processor's cache.
        self._is_occupied = np.zeros(len(self._cells), dtype=bool)
        self._is_occupied[flat] = True

    def near(
        self,
        centres: Float[np.ndarray, "lines 2"],
        normals: Float[np.ndarray, "lines 2"],
        reaches: Float[np.ndarray, "lines"],
        half_width: float,
    ) -> Members:
        """Return the points within a distance of lines and within a reach of their centres."""
        directions = directions_of(normals)
        # Along its major axis a line has one cell in each row or column.
        major = np.argmax(np.abs(directions), axis=1)
        index = np.arange(len(centres))
        # A point next to an end may be farther along the axis than the end.
        spans = reaches * np.abs(directions[index, major]) + half_width
        lows = np.rint(centres[index, major] - spans).astype(int)
        counts = np.rint(centres[index, major] + spans).astype(int) - lows + 1
        # Across, at most sqrt(2) times the distance, and a cell for rounding.
        offsets = np.arange(-1, 2 * int(np.ceil(np.sqrt(2.0) * half_width)) + 2)
        offsets = offsets - int(np.ceil(np.sqrt(2.0) * half_width))
        batches = np.cumsum(counts) * len(offsets) // LOOKUPS_PER_BATCH
        slope = directions[index, 1 - major] / directions[index, major]
        parts = [(np.zeros(0, dtype=int), np.zeros(0, dtype=int))]
        for batch in np.unique(batches):
            some = np.flatnonzero(batches == batch)
            member, place = grouped_indices(counts[some])
            line = some[member]
            step = lows[line] + place
            across = centres[line, 1 - major[line]]
            across = across + slope[line] * (step - centres[line, major[line]])
            minor = np.rint(across).astype(int)[:, None] + offsets
            parts.append(self._in_cells(line, step, minor, major[line]))
        members = Members(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        gaps = self.points[members.point] - centres[members.line]
        close = np.abs((gaps * normals[members.line]).sum(axis=1)) < half_width
        close &= np.abs((gaps * directions[members.line]).sum(axis=1)) <= reaches[members.line]
        return members.of(close)

    def _in_cells(
        self,
        line: Int[np.ndarray, "steps"],
        step: Int[np.ndarray, "steps"],
        minor: Int[np.ndarray, "steps offsets"],
        major: Int[np.ndarray, "steps"],
    ) -> tuple[Int[np.ndarray, "members"], Int[np.ndarray, "members"]]:
        """Return the lines and points of cells; one coordinate of a cell is along the line."""
        step, minor = step - self._origin[major], minor - self._origin[1 - major][:, None]
        inside = (minor >= 0) & (minor < self._size[1 - major][:, None])
        inside &= ((step >= 0) & (step < self._size[major]))[:, None]
        strides = self._strides
        cells = (step * strides[major])[:, None] + minor * strides[1 - major][:, None]
        # Cells outside have no points; any cell is looked up in their place.
        occupied = np.flatnonzero(self._is_occupied.take(cells, mode="clip") & inside)
        points = self._cells[cells.ravel()[occupied]]
        place, layer = np.nonzero(points >= 0)
        return line[occupied[place] // minor.shape[1]], points[place, layer]


def directions_of(normals: Float[np.ndarray, "lines 2"]) -> Float[np.ndarray, "lines 2"]:
    """Return the unit directions of lines, a quarter turn from their normals."""
    return np.column_stack([-normals[:, 1], normals[:, 0]])


def fit_lines(grid: PointGrid, proposals: Float[np.ndarray, "lines 2 2"]) -> LineFits:
    """Return the lines of edge points along proposals and beyond their ends."""
    lines = _towards_light(grid, CentredLines.between(proposals))
    members, alive = Members(np.zeros(0, int), np.zeros(0, int)), np.arange(len(proposals))
    for half_width in BAND_HALF_WIDTHS:
        # Looked up again, because the lines may have grown.
        reaches = 2.0 * lines.half_lengths[alive] + MAX_EXTENSION
        near = grid.near(lines.centres[alive], lines.normals[alive], reaches, half_width)
        near = Members(alive[near.line], near.point)
        runs = _runs(grid, near, lines)
        counts = np.bincount(runs.line, minlength=len(proposals))
        alive = np.flatnonzero(counts >= MIN_POINTS)
        members = runs.of(counts[runs.line] >= MIN_POINTS)
        if not len(alive):
            break
        lines = _refitted(grid, members, lines)
    return LineFits(lines, members)


def _towards_light(grid: PointGrid, lines: CentredLines) -> CentredLines:
    """Return the lines with normals in the direction of most gradients along them."""
    line, point = grid.near(*lines, BAND_HALF_WIDTHS[0])
    alignment = (grid.normals[point] * lines.normals[line]).sum(axis=1)
    # Two edges side by side give both polarities; the more frequent one wins.
    votes = (alignment > MIN_ALIGNMENT).astype(int) - (alignment < -MIN_ALIGNMENT)
    darker = np.bincount(line, votes, minlength=len(lines.centres)) < 0.0
    return lines._replace(normals=np.where(darker[:, None], -lines.normals, lines.normals))


def _runs(grid: PointGrid, near: Members, lines: CentredLines) -> Members:
    """Return for each line the run of points without gaps that covers most of its interval."""
    alignment = (grid.normals[near.point] * lines.normals[near.line]).sum(axis=1)
    near = near.of(alignment > MIN_ALIGNMENT)
    along = along_lines(grid, near, lines.centres, lines.normals)
    order = np.lexsort((along, near.line))
    near, along = Members(near.line[order], near.point[order]), along[order]
    if not len(along):
        return near
    # Cut at the gaps; keep the piece with most points over the proposal.
    is_new = np.r_[True, (np.diff(near.line) > 0) | (np.diff(along) > MAX_GAP)]
    piece = np.cumsum(is_new) - 1
    inside = np.bincount(piece, np.abs(along) <= lines.half_lengths[near.line])
    owners = near.line[is_new]
    best = np.lexsort((np.arange(len(inside)), -inside, owners))
    first = np.r_[True, np.diff(owners[best]) > 0]
    chosen = np.zeros(len(inside), dtype=bool)
    chosen[best[first]] = True
    return near.of(chosen[piece])


def along_lines(
    grid: PointGrid,
    members: Members,
    centres: Float[np.ndarray, "lines 2"],
    normals: Float[np.ndarray, "lines 2"],
) -> Float[np.ndarray, "members"]:
    """Return where points are along their lines, from the centres, px."""
    gaps = grid.points[members.point] - centres[members.line]
    return (gaps * directions_of(normals)[members.line]).sum(axis=1)


def _refitted(grid: PointGrid, members: Members, lines: CentredLines) -> CentredLines:
    """Return the total least-squares lines of the members."""
    middle = middles(members, along_lines(grid, members, lines.centres, lines.normals))
    means, fitted, _ = total_least_squares(grid, middle, lines.normals)
    low, high = ranges(members, along_lines(grid, members, means, fitted), len(means))
    moved = means + 0.5 * (low + high)[:, None] * directions_of(fitted)
    # Lines without points stay unchanged.
    has = np.isfinite(low)
    return CentredLines(
        np.where(has[:, None], moved, lines.centres),
        np.where(has[:, None], fitted, lines.normals),
        np.where(has, 0.5 * (high - low), lines.half_lengths),
    )


def ranges(
    members: Members, values: Float[np.ndarray, "members"], lines: int
) -> tuple[Float[np.ndarray, "lines"], Float[np.ndarray, "lines"]]:
    """Return the smallest and the largest value of each line; NaN without any."""
    low, high = np.full(lines, np.nan), np.full(lines, np.nan)
    np.fmin.at(low, members.line, values)
    np.fmax.at(high, members.line, values)
    return low, high


def middles(members: Members, along: Float[np.ndarray, "members"]) -> Members:
    """Return the points used for fitting: all but those near the ends of a long line."""
    count = int(members.line.max(initial=-1)) + 1
    low, high = ranges(members, along, count)
    margin = np.minimum(END_MARGIN, 0.25 * (high - low))
    line = members.line
    middle = (along >= (low + margin)[line]) & (along <= (high - margin)[line])
    # A short line may have points only at its ends.
    few = np.bincount(line, middle, minlength=count) < 2
    return members.of(middle | few[line])


def total_least_squares(
    grid: PointGrid, members: Members, normals: Float[np.ndarray, "lines 2"]
) -> tuple[Float[np.ndarray, "lines 2"], Float[np.ndarray, "lines 2"], Float[np.ndarray, "lines"]]:
    """Return means, unit normals and variances across the total least-squares lines.

    The normals have the sign of the given ones.
    """
    line, points = members.line, grid.points[members.point]

    def sums(values: Float[np.ndarray, "members"]) -> Float[np.ndarray, "lines"]:
        # Without members bincount returns integers.
        return np.bincount(line, values, minlength=len(normals)).astype(float)

    counts = sums(np.ones(len(line)))
    means = np.column_stack([sums(x) for x in points.T]) / np.maximum(counts, 1.0)[:, None]
    gaps = points - means[line]
    uu, uv, vv = (sums(gaps[:, i] * gaps[:, j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    # The eigenvector of the smaller eigenvalue of the scatter matrix is the normal.
    scatter = np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-1)
    values, vectors = np.linalg.eigh(scatter)
    fitted = vectors[:, :, 0]
    fitted = np.where(((fitted * normals).sum(axis=1) > 0.0)[:, None], fitted, -fitted)
    # Two numbers of each line are fitted.
    return means, fitted, np.maximum(values[:, 0], 0.0) / np.maximum(counts - 2.0, 1.0)
