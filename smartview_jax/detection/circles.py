"""Circle grids, by OpenCV's blob detector and grid finder."""

import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from ..targets import CircleGrid
from .detection import Detection, found, nothing_found, some_found
from .lattice import partial_grid

_SMALLEST_BLOBS = (25.0, 10.0, 60.0, 150.0, 400.0)
"""Least areas to try, px^2: specks must go, and how large a speck is depends on the picture."""

_ROUNDNESS = (0.8, 0.4)
"""Least circularities to try. Thresholds amid the paper's noise let specks grow onto a circle and
shift its centre by half a pixel, but then it is not round; circles seen from the side are not
either."""


MOST_BLOBS = 4
"""Blobs that are looked through, over the circles that are expected. The search for a grid takes
the third power of their number as long, and among so many more they are noise or texture."""

_SIZES = 3.0
"""Largest over smallest diameter of circles in one picture: perspective, and a mark."""


def detect_circles(image: np.ndarray, target: CircleGrid) -> Detection:
    """Circle centres of a grid, in the target's order; of a symmetric grid also a part.

    Args:
        image: grey, uint8.
        target: which grid; with `origin_mark` the larger corner circle comes first.
    """
    count = target.rows * target.columns
    most, tried = 0, []
    for area, roundness in itertools.product(_SMALLEST_BLOBS, _ROUNDNESS):
        parameters = _blob_parameters(area, roundness, target, image.shape)
        blobs = cv2.SimpleBlobDetector.create(parameters).detect(image)
        most = max(most, len(blobs))
        blobs = candidates(blobs, count, image.shape)
        tried.append(blobs)
        if len(blobs) < count:
            continue
        centres = _grid(np.array([blob.pt for blob in blobs]), target)
        if centres is None:
            continue
        if target.origin_mark:
            centres = _origin_first(centres, blobs, target)
        return found(centres)
    missing = f"no whole circle grid of {target.rows} x {target.columns} found: {most} blobs seen, "
    missing += f"{count} expected"
    if most > MOST_BLOBS * count:
        missing += ": there is noise or texture"
    return _part_of_a_grid(max(tried, key=len), target, missing)


def candidates(
    blobs: Sequence[cv2.KeyPoint], count: int, shape: tuple[int, ...]
) -> list[cv2.KeyPoint]:
    """Return the blobs among which a grid of `count` circles is looked for.

    A blob that reaches the border of a picture of this shape is a part of a circle, its centre
    another. Among too many blobs those are taken whose sizes are alike; none where they are still
    more than `MOST_BLOBS` times the circles.
    """
    height, width = shape[:2]

    def is_whole(blob: cv2.KeyPoint) -> bool:
        x, y = blob.pt
        return min(x, y, width - 1.0 - x, height - 1.0 - y) > 0.45 * blob.size

    whole = sorted(filter(is_whole, blobs), key=lambda blob: blob.size)
    if len(whole) > MOST_BLOBS * count:
        sizes = np.array([blob.size for blob in whole])
        ends = np.searchsorted(sizes, _SIZES * sizes, side="right")
        first = int(np.argmax(ends - np.arange(len(sizes))))
        whole = whole[first : ends[first]]
    return whole if len(whole) <= MOST_BLOBS * count else []


def _part_of_a_grid(blobs: list[cv2.KeyPoint], target: CircleGrid, missing: str) -> Detection:
    """Return the circles of a grid that is seen in part, or why it is not used."""
    count = target.rows * target.columns
    if target.asymmetric:
        return nothing_found(count, f"{missing}; an asymmetric grid has to be seen as a whole")
    centres = np.array([blob.pt for blob in blobs], dtype=float).reshape(-1, 2)
    part = partial_grid(centres, np.array([blob.size for blob in blobs]), target)
    if isinstance(part, str):
        return nothing_found(count, f"{missing}; {part}")
    index, which = part
    return some_found(count, index, centres[which])


def _blob_parameters(
    area: float, roundness: float, target: CircleGrid, shape: tuple[int, ...]
) -> cv2.SimpleBlobDetector.Params:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minThreshold, parameters.maxThreshold = 20, 220
    parameters.thresholdStep = 10
    parameters.minRepeatability = 3
    parameters.minDistBetweenBlobs = 5
    parameters.filterByColor = True
    parameters.blobColor = 255 if target.light_on_dark else 0
    parameters.filterByArea = True
    parameters.minArea = area
    # A circle is at most half the pitch wide, and the grid fits the picture.
    parameters.maxArea = 0.8 * shape[0] * shape[1] / (target.rows * target.columns)
    parameters.filterByCircularity = True
    parameters.minCircularity = roundness
    parameters.filterByInertia = False
    parameters.filterByConvexity = True
    parameters.minConvexity = 0.9
    return parameters


def _grid(centres: np.ndarray, target: CircleGrid) -> np.ndarray | None:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    size = (target.columns, target.rows)
    points = centres.astype(np.float32)[:, None]
    for flags in (kind | cv2.CALIB_CB_CLUSTERING, kind):
        # Without a detector the finder takes points in the place of a picture.
        finder = cv2.CirclesGridFinderParameters()
        ok, centres = cv2.findCirclesGrid(points, size, flags, None, finder)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if ok and _is_a_grid(centres.reshape(-1, 2), target):
            return centres.reshape(-1, 2)
    return None


def _is_a_grid(centres: np.ndarray, target: CircleGrid) -> bool:
    """The finder may take a stray blob for a circle: a homography must explain the whole grid."""
    flat = target.points[:, :2] / target.spacing
    H, _ = cv2.findHomography(flat, centres)
    if H is None:
        return False
    mapped = cv2.perspectiveTransform(flat[None], H)[0]
    neighbours = np.linalg.norm(np.diff(mapped, axis=0), axis=1)
    # Lens distortion bends a grid by a few hundredths of a step, a wrong circle by a whole one.
    return float(np.linalg.norm(centres - mapped, axis=1).max()) < 0.3 * float(
        np.median(neighbours)
    )


def _origin_first(
    centres: np.ndarray, blobs: Sequence[cv2.KeyPoint], target: CircleGrid
) -> np.ndarray:
    """Turned so that the larger corner circle comes first, and never mirrored."""
    positions = np.array([blob.pt for blob in blobs])
    sizes = np.array([blob.size for blob in blobs])
    nearest = np.argmin(np.linalg.norm(centres[:, None] - positions[None], axis=-1), axis=1)
    grid = np.concatenate([centres, sizes[nearest][:, None]], axis=1)
    grid = grid.reshape(target.rows, target.columns, 3)
    turns = range(4) if target.rows == target.columns else (0, 2)
    best = max(turns, key=lambda k: np.rot90(grid, k)[0, 0, 2] / _around_corner(np.rot90(grid, k)))
    return np.rot90(grid, best)[..., :2].reshape(-1, 2)


def _around_corner(grid: np.ndarray) -> float:
    """Size of the circles beside the corner: perspective makes a whole side larger."""
    return float(np.mean([grid[0, 1, 2], grid[1, 0, 2], grid[1, 1, 2]]))
