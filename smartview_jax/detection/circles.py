"""Circle grids, by OpenCV's blob detector and grid finder."""

import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from ..targets import CircleGrid
from .detection import Detection, found, nothing_found

_SMALLEST_BLOBS = (25.0, 10.0, 60.0, 150.0, 400.0)
"""Least areas to try, px^2: specks must go, and how large a speck is depends on the picture."""

_ROUNDNESS = (0.8, 0.4)
"""Least circularities to try. Thresholds amid the paper's noise let specks grow onto a circle and
shift its centre by half a pixel, but then it is not round; circles seen from the side are not
either."""


def detect_circles(image: np.ndarray, target: CircleGrid) -> Detection:
    """Circle centres of a whole grid, in the target's order.

    Args:
        image: grey, uint8.
        target: which grid; with `origin_mark` the larger corner circle comes first.
    """
    count = target.rows * target.columns
    most = 0
    for area, roundness in itertools.product(_SMALLEST_BLOBS, _ROUNDNESS):
        parameters = _blob_parameters(area, roundness, target, image.shape)
        detector = cv2.SimpleBlobDetector.create(parameters)
        blobs = detector.detect(image)
        most = max(most, len(blobs))
        if len(blobs) < count:
            continue
        centres = _grid(image, target, detector)
        if centres is None:
            continue
        if target.origin_mark:
            centres = _origin_first(centres, blobs, target)
        return found(centres)
    return nothing_found(
        count,
        f"no circle grid of {target.rows} x {target.columns} found: {most} blobs seen, "
        f"{count} expected",
    )


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


def _grid(
    image: np.ndarray, target: CircleGrid, detector: cv2.SimpleBlobDetector
) -> np.ndarray | None:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if target.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    size = (target.columns, target.rows)
    for flags in (kind | cv2.CALIB_CB_CLUSTERING, kind):
        ok, centres = cv2.findCirclesGrid(image, size, flags=flags, blobDetector=detector)
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
