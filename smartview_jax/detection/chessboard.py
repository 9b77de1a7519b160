"""Detect chessboard corners with OpenCV's sector-based or classic detector."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from ..targets import Chessboard, grid_symmetries
from .detection import Detection, empty_detection, full_detection
from .plausibility import DetectionLimits, checked_detection

_SUBPIXEL_REACH = 0.25
"""Half width of a corner's refinement window, as a fraction of the distance to the nearest corner.

The window must not reach another corner, even if the board is seen from the side.
"""

_SUBPIXEL_WINDOWS = (2, 10)
"""Smallest and largest half width of this window, px."""

_SUBPIXEL_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)

_SAMPLE_REACH = 0.35
"""Distance from a corner at which the four squares around it are sampled, in squares."""

_LEAST_SADDLE = 0.75
"""Saddle (see `_saddles`) above which a line of points consists of inner corners.

The saddle is 1 for inner corners, and 0.5 along the board's outline, where two of the four squares
around a point are equal.
"""


def detect_chessboard(
    image: np.ndarray, target: Chessboard, limits: DetectionLimits | None = None
) -> Detection:
    """Detect the inner corners of a completely visible board in a grey picture, in target order.

    The sector-based detector is accurate, but may be wrong by many pixels if the white margin is
    narrow, and may find nothing where the classic detector does. So each detection is tested, and
    the classic detector is tried if the first detection fails or is noisy.
    """
    limits = limits or DetectionLimits()
    size = (image.shape[1], image.shape[0])
    failed, candidates = [], []
    for detection in _candidates(image, target):
        tested = checked_detection(detection, target.points, size, limits)
        if tested.reason is None and (problem := _outline_problem(image, detection.pixels, target)):
            tested = empty_detection(len(target.points), problem)
        if tested.reason is not None:
            failed.append(tested)
            continue
        candidates.append(tested)
        if tested.visible.all() and tested.noise <= limits.good_noise(
            _smallest_distance(detection)
        ):
            break
    if candidates:
        return min(
            candidates,
            key=lambda detection: (-np.count_nonzero(detection.visible), detection.noise),
        )
    return (
        failed[0]
        if failed
        else empty_detection(
            target.rows * target.columns,
            f"no chessboard with {target.rows} x {target.columns} inner corners found",
        )
    )


def _candidates(image: np.ndarray, target: Chessboard) -> Iterator[Detection]:
    """Yield the detections of both detectors; the second runs only if it is needed."""
    detectors: tuple[Callable[..., np.ndarray | None], ...] = (_sector_based, _classic)
    for detector in detectors:
        corners = detector(image, (target.columns, target.rows))
        if corners is not None:
            yield full_detection(_start_at_light_square(image, corners.reshape(-1, 2), target))


def _sector_based(image: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """Return the corners that OpenCV's sector-based detector finds."""
    # No refinement by `cornerSubPix`, which shifts these corners by up to half a pixel, and no
    # normalisation of the picture, which shifts them by 0.1 to 0.2 px.
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    is_found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
    return corners if is_found else None


def _classic(image: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """Return the corners that OpenCV's classic detector finds, refined to sub-pixels."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    is_found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    if not is_found:
        return None
    reach = int(_SUBPIXEL_REACH * _smallest_distance(full_detection(corners)))
    reach = int(np.clip(reach, *_SUBPIXEL_WINDOWS))
    return cv2.cornerSubPix(image, corners, (reach, reach), (-1, -1), _SUBPIXEL_CRITERIA)


def _smallest_distance(detection: Detection) -> float:
    """Return the smallest distance between two detected corners, px."""
    return float(KDTree(detection.pixels).query(detection.pixels, k=2)[0][:, 1].min())


def _outline_problem(
    image: np.ndarray, corners: Float[np.ndarray, "corners 2"], target: Chessboard
) -> str | None:
    """Return an error text if the number of rows and columns is wrong; otherwise None.

    Part of a larger board looks like a complete smaller board, and the outline of a board looks
    like one more line of corners.
    """
    grid = corners.reshape(target.rows, target.columns, 2)
    if min(grid.shape[:2]) < 3:
        return None
    # One more line of points is extrapolated quadratically on every side; the corners are filled
    # by the columns, which come last.
    outer = np.pad(grid, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    for side in (outer, outer[::-1], outer.swapaxes(0, 1), outer.swapaxes(0, 1)[::-1]):
        side[0] = 3.0 * side[1] - 3.0 * side[2] + side[3]
    saddles = _saddles(image, outer)
    # The sign depends on whether the first square is dark.
    saddles *= np.sign(np.nanmean(saddles[1:-1, 1:-1]))
    stated = f"{target.rows} x {target.columns} inner corners"
    for side in (saddles, saddles[::-1], saddles.T, saddles.T[::-1]):
        beyond, last = side[0, 1:-1], side[1, 1:-1]
        if np.isfinite(last).any() and np.nanmean(last) < _LEAST_SADDLE:
            return (
                f"the outermost points found are not inner corners of a board with {stated}: check "
                "rows and columns"
            )
        # A line that is mostly outside the picture is not judged.
        if np.isfinite(beyond).mean() > 0.5 and np.nanmean(beyond) > _LEAST_SADDLE:
            return f"the board is larger than {stated}: check rows and columns"
    return None


def _saddles(
    image: np.ndarray, grid: Float[np.ndarray, "rows columns 2"]
) -> Float[np.ndarray, "rows columns"]:
    """Return how much the four squares around each point look like an inner corner.

    It is 1 for an inner corner, 0 for a point within a square or on an edge between two squares,
    and NaN outside the picture. Alternating signs make it equal for all inner corners of a board.
    """
    across, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    samples = []
    for i, j in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        x, y = np.moveaxis(grid + _SAMPLE_REACH * (i * across + j * down), -1, 0)
        sample = cv2.remap(
            image.astype(np.float32),
            x.astype(np.float32),
            y.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float("nan"),
        )
        samples.append(sample)
    # With the squares a, b on one diagonal and c, d on the other,
    #     (a + b - c - d) / (2 (largest - smallest)),
    # which light and shadow do not change; one grey value is added against division by zero.
    difference = np.max(samples, axis=0) - np.min(samples, axis=0) + 1.0
    saddles = (samples[0] + samples[1] - samples[2] - samples[3]) / (2.0 * difference)
    # At every second corner the dark squares are on the other diagonal.
    return saddles * (-1.0) ** np.add.outer(np.arange(len(grid)), np.arange(len(grid[0])))


def _start_at_light_square(
    image: np.ndarray, corners: Float[np.ndarray, "corners 2"], target: Chessboard
) -> Float[np.ndarray, "corners 2"]:
    """Return the corners in an order whose first square is light, if there is one."""
    # With the brightness b of each square's middle and s = +1, -1, +1, ... over the squares, the
    # first square is light if sum s (b - mean b) > 0. All squares are compared, so that a single
    # square in shadow does not decide.
    rows, columns = target.rows, target.columns
    sign = (-1.0) ** np.add.outer(np.arange(rows - 1), np.arange(columns - 1))
    for order in grid_symmetries(rows, columns):
        grid = corners[order].reshape(rows, columns, 2)
        centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4.0
        x, y = np.moveaxis(centres.astype(np.float32), -1, 0)
        brightness = cv2.remap(image, x, y, cv2.INTER_LINEAR)
        if np.mean(sign * brightness) > np.mean(sign) * np.mean(brightness):
            return corners[order]
    return corners
