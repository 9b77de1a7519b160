"""Detect circle grids with OpenCV's blob detector and grid finder."""

import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from ..targets import CircleGrid
from .detection import Detection, empty_detection, full_detection, partial_detection
from .lattice import match_partial_grid

_MIN_BLOB_AREAS = (25.0, 10.0, 60.0, 150.0, 400.0)
"""Lower limits on a blob's area to try, px^2.

Specks of noise have to be excluded, and their size depends on the picture.
"""

_MIN_CIRCULARITIES = (0.8, 0.4)
"""Lower limits on a blob's circularity to try, without unit.

At brightness thresholds within the noise of the paper, specks merge with a circle and shift its
centre by half a pixel. The high limit excludes them, since the blob is then not round. The low
limit is tried because circles that are seen from the side are not round either.
"""

MAX_BLOBS_PER_CIRCLE = 4
"""Largest number of blobs to search, as a multiple of the number of circles.

The search for a grid takes time proportional to the third power of the number of blobs, and a
larger number indicates noise or texture.
"""

_MAX_DIAMETER_RATIO = 3.0
"""Largest expected ratio of circle diameters in one picture, due to perspective and a mark."""

_MIN_MARK_RATIO = 1.15
"""Ratio of two corner circles, both compared with their neighbours, from which the larger one is
the mark: unmarked circles differ from their neighbours by a few hundredths."""

_MAX_RATIO_BEYOND = 1.6
"""Largest ratio of a further circle's diameter to the grid's, due to perspective or a mark."""


def detect_circles(image: np.ndarray, target: CircleGrid) -> Detection:
    """Detect the circle centres of a grid in a grey picture, in the target's order.

    A symmetric grid may be visible only in part. An origin mark, a larger circle, comes first.
    """
    # No single pair of limits suits all pictures, so pairs are tried until a whole grid is found.
    # If none is found, part of a grid is searched for, with the pair that gave the most blobs.
    count = target.rows * target.columns
    max_blob_count, candidate_sets = 0, []
    for min_area, min_circularity in itertools.product(_MIN_BLOB_AREAS, _MIN_CIRCULARITIES):
        parameters = _blob_parameters(min_area, min_circularity, target, image.shape)
        blobs = cv2.SimpleBlobDetector.create(parameters).detect(image)
        max_blob_count = max(max_blob_count, len(blobs))
        blobs = candidate_blobs(blobs, count, image.shape)
        candidate_sets.append(blobs)
        if len(blobs) < count:
            continue
        centres = _find_grid(np.array([blob.pt for blob in blobs]), target)
        if centres is None:
            continue
        if _goes_on(centres, blobs, target):
            return empty_detection(
                count,
                f"the grid is larger than {target.rows} x {target.columns} circles: check rows and "
                "columns",
            )
        if target.origin_mark:
            centres = _start_at_origin_mark(centres, blobs, target)
            if centres is None:
                return empty_detection(
                    count,
                    f"the larger circle is in a corner where a grid of {target.rows} x "
                    f"{target.columns} does not begin: rows and columns were exchanged, or the "
                    "picture is mirrored",
                )
        return full_detection(centres)
    reason = (
        f"no whole circle grid of {target.rows} x {target.columns} found: "
        f"{max_blob_count} blobs seen, {count} expected"
    )
    if max_blob_count > MAX_BLOBS_PER_CIRCLE * count:
        reason += "; the picture has noise or texture"
    return _detect_partial_grid(max(candidate_sets, key=len), target, reason)


def candidate_blobs(
    blobs: Sequence[cv2.KeyPoint], count: int, shape: tuple[int, ...]
) -> list[cv2.KeyPoint]:
    """Return the blobs in which a grid of circles is searched for.

    Blobs that reach the border of the picture are excluded: they are parts of circles, and their
    centres are wrong. If too many remain, the largest group of similar size is returned; if even
    this group has more than `MAX_BLOBS_PER_CIRCLE` blobs per circle, none is returned.
    """
    height, width = shape[:2]

    def is_whole(blob: cv2.KeyPoint) -> bool:
        """Return whether a blob's centre is more than 0.45 of its diameter from every border."""
        x, y = blob.pt
        return min(x, y, width - 1.0 - x, height - 1.0 - y) > 0.45 * blob.size

    whole = sorted(filter(is_whole, blobs), key=lambda blob: blob.size)
    if len(whole) > MAX_BLOBS_PER_CIRCLE * count:
        # Sorted by diameter, the blobs first ... end - 1 are within the allowed ratio of the
        # diameter of the first; the longest such group is taken.
        diameters = np.array([blob.size for blob in whole])
        ends = np.searchsorted(diameters, _MAX_DIAMETER_RATIO * diameters, side="right")
        first = int(np.argmax(ends - np.arange(len(diameters))))
        whole = whole[first : ends[first]]
    return whole if len(whole) <= MAX_BLOBS_PER_CIRCLE * count else []


def _detect_partial_grid(blobs: list[cv2.KeyPoint], target: CircleGrid, reason: str) -> Detection:
    """Return the circles of a partly visible grid, or an empty detection with a further reason."""
    count = target.rows * target.columns
    if target.asymmetric:
        return empty_detection(count, f"{reason}; an asymmetric grid must be visible completely")
    centres = np.array([blob.pt for blob in blobs], dtype=float).reshape(-1, 2)
    match = match_partial_grid(centres, np.array([blob.size for blob in blobs]), target)
    if isinstance(match, str):
        return empty_detection(count, f"{reason}; {match}")
    index, blob_indices = match
    return partial_detection(count, index, centres[blob_indices])


def _blob_parameters(
    min_area: float, min_circularity: float, target: CircleGrid, shape: tuple[int, ...]
) -> cv2.SimpleBlobDetector.Params:
    """Return the settings of OpenCV's blob detector, for pictures of a shape."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minThreshold, parameters.maxThreshold = 20, 220
    parameters.thresholdStep = 10
    parameters.minRepeatability = 3
    parameters.minDistBetweenBlobs = 5
    parameters.filterByColor = True
    parameters.blobColor = 255 if target.light_on_dark else 0
    parameters.filterByArea = True
    parameters.minArea = min_area
    # The whole grid fits into the picture, and a circle is smaller than its cell of the grid, whose
    # area is at most height width / (rows columns).
    parameters.maxArea = 0.8 * shape[0] * shape[1] / (target.rows * target.columns)
    parameters.filterByCircularity = True
    parameters.minCircularity = min_circularity
    parameters.filterByInertia = False
    parameters.filterByConvexity = True
    parameters.minConvexity = 0.9
    return parameters


def _find_grid(centres: np.ndarray, target: CircleGrid) -> np.ndarray | None:
    """Return the centres that form a whole grid, in OpenCV's order; None if there is no grid."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    size = (target.columns, target.rows)
    points = centres.astype(np.float32)[:, None]
    # Clustering tolerates perspective better; the plain search tolerates other blobs better.
    for flags in (kind | cv2.CALIB_CB_CLUSTERING, kind):
        # With None as the blob detector, the finder accepts points instead of a picture.
        finder = cv2.CirclesGridFinderParameters()
        is_found, centres = cv2.findCirclesGrid(points, size, flags, None, finder)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if is_found and _is_grid(centres.reshape(-1, 2), target):
            return centres.reshape(-1, 2)
    return None


def _is_grid(centres: np.ndarray, target: CircleGrid) -> bool:
    """Return whether one homography maps the target's grid to the centres.

    OpenCV's finder may mistake another blob for a circle.
    """
    flat = target.points[:, :2] / target.spacing
    H, _ = cv2.findHomography(flat, centres)
    if H is None:
        return False
    mapped = cv2.perspectiveTransform(flat[None], H)[0]
    neighbour_distances = np.linalg.norm(np.diff(mapped, axis=0), axis=1)
    # Largest residual < 0.3 median distance between neighbours. Lens distortion causes residuals of
    # a few hundredths of this distance, a wrong circle causes a residual of the whole distance.
    return float(np.linalg.norm(centres - mapped, axis=1).max()) < 0.3 * float(
        np.median(neighbour_distances)
    )


def _goes_on(centres: np.ndarray, blobs: Sequence[cv2.KeyPoint], target: CircleGrid) -> bool:
    """Return whether there are circles beyond the stated rows or columns, on any side.

    Part of a larger grid looks like a complete smaller grid.
    """
    grid = centres.reshape(target.rows, target.columns, 2)
    positions = np.array([blob.pt for blob in blobs])
    diameters = np.array([blob.size for blob in blobs])
    used = np.linalg.norm(positions[:, None] - centres[None], axis=-1).argmin(axis=0)
    usual_diameter = np.median(diameters[used])
    free = np.ones(len(blobs), dtype=bool)
    free[used] = False
    similar = np.maximum(diameters, usual_diameter) < _MAX_RATIO_BEYOND * np.minimum(
        diameters, usual_diameter
    )
    others = positions[free & similar]
    if not len(others):
        return False
    for lines in (grid, grid[::-1], grid.swapaxes(0, 1), grid.swapaxes(0, 1)[::-1]):
        if len(lines) < 3:
            continue
        # In a grid with shifted rows, the row before the last shows how the next row is shifted.
        step = 0.5 * (lines[2] - lines[0])
        expected = lines[1] - 2.0 * step
        reach = 0.5 * np.linalg.norm(step, axis=1)
        nearest = np.linalg.norm(expected[:, None] - others[None], axis=-1).min(axis=1)
        if np.mean(nearest < reach) > 0.5:
            return True
    return False


def _start_at_origin_mark(
    centres: np.ndarray, blobs: Sequence[cv2.KeyPoint], target: CircleGrid
) -> np.ndarray | None:
    """Return the centres rotated so that the larger corner circle is first, never mirrored.

    None if it is in a corner from which only a mirrored grid, or one of as many rows as this has
    columns, goes on as far to both sides.
    """
    # For every rotation that maps the grid to itself, the diameter of the first corner is compared
    # with the mean of its three neighbours.
    positions = np.array([blob.pt for blob in blobs])
    diameters = np.array([blob.size for blob in blobs])
    nearest = np.argmin(np.linalg.norm(centres[:, None] - positions[None], axis=-1), axis=1)
    # Cells of the grid are (u, v, diameter), px.
    grid = np.concatenate([centres, diameters[nearest][:, None]], axis=1)
    grid = grid.reshape(target.rows, target.columns, 3)
    quarter_rotations = range(4) if target.rows == target.columns else (0, 2)
    sizes = [
        float(np.rot90(grid, k)[0, 0, 2] / _mean_neighbour_diameter(np.rot90(grid, k)))
        for k in range(4)
    ]
    best = max(quarter_rotations, key=lambda k: sizes[k])
    if max(sizes) > _MIN_MARK_RATIO * sizes[best]:
        return None
    return np.rot90(grid, best)[..., :2].reshape(-1, 2)


def _mean_neighbour_diameter(grid: np.ndarray) -> float:
    """Return the mean diameter of the three circles around the first corner, px.

    The corner is compared with its neighbours because perspective makes a whole side larger.
    """
    return float(np.mean([grid[0, 1, 2], grid[1, 0, 2], grid[1, 1, 2]]))
