"""Detect boards with numbered markers: ChArUco boards and grids of AprilTag or ArUco tags.

A view may show only a part of the board.
"""

import cv2
import numpy as np
from jaxtyping import Float

from ..targets import AprilGrid, Charuco, TagGrid
from .detection import Detection, empty_detection, partial_detection

_BORDERS = (1, 2, 3)
"""Common widths of a tag's border, in cells; they are tried if nothing is found."""

_TAG_WINDOW = 0.3
"""Half width of the window in which a single tag's corner is refined, in cells: OpenCV's own."""

_APRIL_GRID_WINDOW = 0.75
"""The same for an AprilGrid, as a fraction of the narrowest of the four squares around a corner.

The squares are the tag's border, the square beyond the corner, and the white gaps between them.
OpenCV finds such corners less accurately, so the window is as wide as the squares allow.
"""

_WINDOWS = (1, 5)
"""Smallest and largest half width of this window, px."""

_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.1)
"""Criteria for the end of a corner's refinement, OpenCV's own for tags."""


def dictionary_by_name(name: str) -> cv2.aruco.Dictionary:
    """Return one of OpenCV's marker dictionaries by its name there."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def charuco_board(target: Charuco) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's description of a ChArUco board."""
    board = cv2.aruco.CharucoBoard(
        (target.squares_x, target.squares_y),
        target.square,
        target.marker,
        dictionary_by_name(target.dictionary),
    )
    board.setLegacyPattern(target.legacy)
    return board


def detect_charuco(image: np.ndarray, target: Charuco) -> Detection:
    """Detect the inner corners of a ChArUco board that are between recognised markers."""
    count = (target.squares_x - 1) * (target.squares_y - 1)
    detector = cv2.aruco.CharucoDetector(charuco_board(target))
    corners, ids, _, marker_ids = detector.detectBoard(image)
    if ids is None or len(ids) == 0:
        marker_count = 0 if marker_ids is None else len(marker_ids)
        seen = f"{marker_count} markers of {target.dictionary} seen"
        if repeated := _repeated_markers(image, target):
            # A reflection does not do it: hardly any mirrored marker is recognised.
            seen = (
                f"{repeated} markers are seen more than once: are two such boards in view? Cover "
                "one of them"
            )
        return empty_detection(count, f"no ChArUco corner found ({seen})")
    return partial_detection(count, ids.ravel(), corners)


def _repeated_markers(image: np.ndarray, target: Charuco) -> int:
    """Return how many of a board's markers a picture shows more than once."""
    detector = cv2.aruco.ArucoDetector(dictionary_by_name(target.dictionary))
    _, ids, _ = detector.detectMarkers(image)
    if ids is None:
        return 0
    numbers, counts = np.unique(ids, return_counts=True)
    return int(np.count_nonzero(counts[np.isin(numbers, charuco_board(target).getIds())] > 1))


def detect_tags(image: np.ndarray, target: TagGrid | AprilGrid) -> Detection:
    """Detect the four corners of every visible tag of a grid, with sub-pixel refinement.

    A corner whose refinement fails is not visible. Tags whose border differs from the target's are
    not accepted, because their corners would be wrong by one cell of the code.
    """
    count = 4 * len(target.ids)
    tags = find_tags(image, target, target.border_bits)
    if len(tags) < 0.5 * len(target.ids) and (other := _other_border(image, target, len(tags))):
        return empty_detection(
            count,
            f"{len(tags)} tags have a border of {_cells_in_words(target.border_bits)}, more tags "
            f"have a border of {_cells_in_words(other)}: state border_bits: {other}",
        )
    if not tags:
        return empty_detection(count, _reason_for_no_tags(image, target))
    refined = {tag: _refined_corners(image, corners, target) for tag, corners in tags.items()}
    wider = [
        _has_wider_border(image, np.where(np.isfinite(refined[tag]), refined[tag], corners), target)
        for tag, corners in tags.items()
    ]
    if np.mean(wider) > 0.5:
        return empty_detection(
            count,
            f"{len(tags)} tags found, but their border is wider than "
            f"{_cells_in_words(target.border_bits)}: state border_bits, 2 for a board of Kalibr's",
        )
    pixels = np.full((count, 2), np.nan)
    for tag, corners in refined.items():
        # Corner k of the tag with number n is point 4 (n - first_id) + corner_order[k].
        pixels[4 * (tag - target.first_id) + np.array(target.corner_order)] = corners
    if not np.isfinite(pixels).any():
        return empty_detection(count, f"{len(tags)} tags found, but no corner could be refined")
    return Detection(pixels, np.asarray(np.isfinite(pixels).all(axis=1)), None)


def find_tags(
    image: np.ndarray, target: TagGrid | AprilGrid, border_bits: int
) -> dict[int, Float[np.ndarray, "4 2"]]:
    """Return the corners of the target's tags by number, not refined, px.

    A number that is found more than once is left out, because one of its tags is not the target's.
    """
    detector = marker_detector(dictionary_by_name(target.dictionary), border_bits)
    pictures = [(image, 0)]
    if isinstance(target, AprilGrid):
        # The squares at the corners of a tag connect it to its neighbours. Dilating the light areas
        # by one pixel separates them, and moves the tag's sides inwards by one pixel.
        pictures.append((cv2.dilate(image, np.ones((3, 3), np.uint8)), 1))
    best: dict[int, np.ndarray] = {}
    for picture, shift in pictures:
        corners, ids, _ = detector.detectMarkers(picture)
        numbers = [] if ids is None else [int(k) for k in ids.ravel()]
        tags = {
            tag: _grown(quad.reshape(4, 2), shift)
            for tag, quad in zip(numbers, corners, strict=True)
            if tag in target.ids and numbers.count(tag) == 1
        }
        best = {**best, **tags}
    return best


def _grown(corners: Float[np.ndarray, "4 2"], shift: int) -> Float[np.ndarray, "4 2"]:
    """Return a square's corners after each side has moved outwards by a distance, px."""
    side = np.mean(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1))
    middle = corners.mean(axis=0)
    return middle + (corners - middle) * (1.0 + 2.0 * shift / side)


def _other_border(image: np.ndarray, target: TagGrid | AprilGrid, count: int) -> int | None:
    """Return the width of a border with which more tags are found than `count`, or None."""
    counts = {
        bits: len(find_tags(image, target, bits)) for bits in _BORDERS if bits != target.border_bits
    }
    best = max(counts, key=lambda bits: counts[bits])
    return best if counts[best] > count else None


def _reason_for_no_tags(image: np.ndarray, target: TagGrid | AprilGrid) -> str:
    """Return the error text that no tag of the target was found, with the other tags found."""
    reason = f"no tag {target.ids[0]} to {target.ids[-1]} of {target.dictionary} found"
    _, ids, _ = marker_detector(
        dictionary_by_name(target.dictionary), target.border_bits
    ).detectMarkers(image)
    others = [] if ids is None else sorted(int(k) for k in ids.ravel())
    return f"{reason}, but tags {others}" if others else reason


def marker_detector(dictionary: cv2.aruco.Dictionary, border_bits: int) -> cv2.aruco.ArucoDetector:
    """Return OpenCV's detector for the markers of a dictionary with the given border."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def _cells_in_words(border_bits: int) -> str:
    """Return the width of a border in words."""
    return f"{border_bits} cell{'s' if border_bits > 1 else ''}"


def _has_wider_border(
    image: np.ndarray, corners: Float[np.ndarray, "4 2"], target: TagGrid | AprilGrid
) -> bool:
    """Return whether a tag is black just outside its corners, as it is just inside.

    A detector that expects too narrow a border finds the inner edge of the border.
    """
    cells = dictionary_by_name(target.dictionary).markerSize + 2 * target.border_bits
    unit = np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(unit, corners.astype(np.float32))
    # Only the middle half of each side is sampled, because other squares touch the corners.
    along = np.linspace(0.25, 0.75, 16) * cells
    step = 0.5 * min(1.0, _gap_in_cells(target, cells))

    def sides(offset: float) -> np.ndarray:
        """Return grey values along the four sides, at a distance of `offset` cells outwards."""
        low, high = np.full_like(along, -offset), np.full_like(along, cells + offset)
        pairs = (along, low), (along, high), (low, along), (high, along)
        positions = np.concatenate([np.stack(pair, axis=1) for pair in pairs])
        x, y = cv2.perspectiveTransform(positions[None], H)[0].T.astype(np.float32)
        return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    inside, outside = np.median(sides(-0.5)), np.median(sides(step))
    light = np.percentile(image[_bounding_box(corners, image.shape)], 95)
    return bool(outside < 0.5 * (inside + light))


def _gap_in_cells(target: TagGrid | AprilGrid, cells: int) -> float:
    """Return the white gap between two tags in cells of their codes; 1 for a single tag."""
    if isinstance(target, AprilGrid):
        return 1.0 if len(target.ids) == 1 else target.spacing * cells
    return 1.0 if not target.gap or len(target.ids) == 1 else target.gap / target.size * cells


def _bounding_box(corners: Float[np.ndarray, "4 2"], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of the picture that a tag covers."""
    low = np.floor(corners.min(axis=0)).astype(int)
    high = np.ceil(corners.max(axis=0)).astype(int) + 1
    (left, top), (right, bottom) = np.maximum(low, 0), high
    return slice(top, min(bottom, shape[0])), slice(left, min(right, shape[1]))


def _refined_corners(
    image: np.ndarray, corners: Float[np.ndarray, "4 2"], target: TagGrid | AprilGrid
) -> Float[np.ndarray, "4 2"]:
    """Return a tag's corners with sub-pixel accuracy; NaN where the refinement failed."""
    cells = dictionary_by_name(target.dictionary).markerSize + 2 * target.border_bits
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    window = _TAG_WINDOW
    if isinstance(target, AprilGrid):
        window = _APRIL_GRID_WINDOW * min(target.border_bits, target.spacing * cells)
    reach = int(np.clip(round(window * sides.mean() / cells), *_WINDOWS))
    start = corners.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, start.copy(), (reach, reach), (-1, -1), _CRITERIA)
    moved = np.linalg.norm((refined - start).reshape(4, 2), axis=1)
    # `cornerSubPix` returns the start for a corner that would leave its window.
    has_failed = (moved == 0.0) | (moved > reach)
    return np.where(has_failed[:, None], np.nan, refined.reshape(4, 2))
