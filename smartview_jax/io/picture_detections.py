"""Detect a target in all pictures of a data set, unless the detections were kept."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ..detection import (
    Detection,
    DetectionLimits,
    content_hash,
    decode_picture,
    detect,
    detection_identity,
    empty_detection,
    picture_bytes,
    read_picture,
)
from ..features import target_edge_width
from ..geometry import PoseLike
from ..targets import AbstractTarget, StackedTarget
from .detections import KeptDetection, read_kept_detections, write_kept_detections
from .folder_pictures import LoadOptions
from .view_names import is_picture_name

_MEASURED = "edge width"
"""What is measured beyond the points; kept detections without it are made again."""

_DECIDING_PICTURES = 3
"""Number of pictures of one wrong size after which no more pictures are checked."""


class ShownTarget(NamedTuple):
    """The target that pictures show, and what is known of the pictures before.

    Attributes:
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_size: width and height of every picture, px; None for the first picture's.
        holder_from_world: approximate pose of the target: `base_from_world`, or `tool_from_world`
            for a fixed camera. It decides the orientation of a pattern that looks the same when
            rotated; by default the orientation with the smallest rotation.
        board_heights: index of the height of a `StackedTarget` in the only picture of a view, by
            view id; None where every view has a picture for each height.
    """

    target: AbstractTarget
    mount: str = "eye_in_hand"
    image_size: tuple[int, int] | None = None
    holder_from_world: PoseLike | None = None
    board_heights: Mapping[str, int] | None = None


def detect_views(
    pictures: Mapping[str, Sequence[Path]],
    shown: ShownTarget,
    options: LoadOptions,
    cache: Path | None = None,
) -> tuple[dict[str, Detection], tuple[int, int]]:
    """Detect the target in every view, and return the detections and the pictures' size, px."""
    report_progress = options.progress or (lambda _: None)
    limits, target = options.detection_limits or DetectionLimits(), shown.target
    _refuse_missing(pictures, options.bad_views == "mask")
    image_size = _checked_size(pictures, shown.image_size)
    kept = {} if cache is None else read_kept_detections(cache, list(pictures), len(target.points))
    common = repr((detection_identity(target), limits, image_size, cv2.__version__, _MEASURED))
    entries: dict[str, KeptDetection] = {}
    for number, (view, paths) in enumerate(pictures.items(), start=1):
        height = None if shown.board_heights is None else shown.board_heights[view]
        try:
            contents = [picture_bytes(path) for path in paths]
            digests = [content_hash(content) for content in contents]
            key = hashlib.sha256(repr((common, height, digests)).encode()).hexdigest()[:16]
            if view in kept and kept[view].key == key:
                entries[view] = kept[view]
                continue
            report_progress(f"looking for the target: view {view} ({number} of {len(pictures)})")
            detection = _detect_view(paths, contents, target, image_size, height, limits)
            entries[view] = KeptDetection(key, detection)
        except (FileNotFoundError, ValueError) as error:
            if options.bad_views != "mask":
                raise
            entries[view] = KeptDetection("", empty_detection(len(target.points), str(error)))
    detections = {view: detection for view, (_, detection) in entries.items()}
    if all(not key for key, _ in entries.values()):
        raise ValueError(f"no picture can be used: {next(iter(detections.values())).reason}")
    if cache is not None:
        _keep(cache, kept, entries, report_progress)
    return detections, image_size


def _keep(
    cache: Path,
    kept: Mapping[str, KeptDetection],
    entries: Mapping[str, KeptDetection],
    report_progress: Callable[[str], None],
) -> None:
    """Write the detections to the file, unless all of them come from it."""
    usable = {view: entry for view, entry in entries.items() if entry.key}
    if all(kept.get(view) is entry for view, entry in usable.items()):
        report_progress(f"detections of {len(usable)} views from {cache.name}")
        return
    try:
        write_kept_detections(cache, usable)
    # The file only saves time, so a read-only folder is not an error.
    except OSError as error:
        report_progress(f"detections are not kept: {error}")


def _detect_view(
    paths: Sequence[Path],
    contents: Sequence[bytes],
    target: AbstractTarget,
    image_size: tuple[int, int],
    height: int | None,
    limits: DetectionLimits,
) -> Detection:
    """Detect the target in a view's pictures; the heights of a stacked target are concatenated.

    Of a picture at a single height the points at the others are not visible.
    """
    board = target.flat_board
    parts, reasons = [], []
    for path, content in zip(paths, contents, strict=True):
        picture = decode_picture(path, content, image_size)
        part = detect(picture.grey, board, limits)
        width = target_edge_width(picture.grey, part.pixels[part.visible])
        parts.append(part._replace(edge_width=width))
        if part.reason:
            reasons.append(f"{part.reason}; {picture.range_in_words}")
    if height is not None and isinstance(target, StackedTarget):
        (detection,), absent = parts, empty_detection(len(board.points), "")
        parts = [detection if k == height else absent for k in range(len(target.heights))]
    return Detection(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.visible for part in parts]),
        "; ".join(reasons) or None,
        max(part.noise for part in parts),
        sum(part.left_out for part in parts),
        max((part.edge_width for part in parts if part.edge_width is not None), default=None),
    )


def _refuse_missing(pictures: Mapping[str, Sequence[Path]], masked: bool) -> None:
    """Raise a FileNotFoundError for a missing picture, or where views are masked for all of them.

    If none exists, the folder or the suffix is wrong: the error lists what the folder has.
    """
    paths = [path for view_paths in pictures.values() for path in view_paths]
    if not paths:
        raise ValueError("pictures: expected at least one view")
    missing = [path for path in paths if not path.is_file()]
    if len(missing) < len(paths):
        if missing and not masked:
            raise FileNotFoundError(f"{missing[0]}: no such picture")
        return
    first = paths[0]
    if not first.parent.is_dir():
        raise FileNotFoundError(f"{first}: no such picture: there is no folder {first.parent}")
    others = [file for file in sorted(first.parent.iterdir()) if is_picture_name(file)]
    content = f"such as {others[0].name}" if others else "no pictures"
    if not others:
        below = sorted(filter(is_picture_name, first.parent.glob(f"*/*{first.suffix}")))
        if below:
            content = (
                f"none itself but in folders, such as {below[0].relative_to(first.parent)}: put "
                "them all into one folder"
            )
    raise FileNotFoundError(
        f"{first}: no such picture, nor any other of {len(paths)}; {first.parent} has "
        f"{f'{len(others)} others, ' if others else ''}{content}: does the pattern have the right "
        "folder and suffix?"
    )


def _checked_size(
    pictures: Mapping[str, Sequence[Path]], stated: tuple[int, int] | None
) -> tuple[int, int]:
    """Return the stated size of the pictures, or the first picture's if none is stated."""
    first_error: Exception | None = None
    other_sizes: list[tuple[int, int]] = []
    for path in (path for paths in pictures.values() for path in paths):
        try:
            rows, columns = read_picture(path).shape
        except (FileNotFoundError, ValueError) as error:
            first_error = first_error or error
            continue
        if stated is None or (columns, rows) == tuple(stated):
            return columns, rows
        other_sizes.append((columns, rows))
        first_error = first_error or ValueError(
            f"{path}: expected {stated[0]} x {stated[1]} px, found {columns} x {rows}: is the "
            "stated picture size right?"
        )
        # A picture or two may be stray; three of one size are the data set's.
        if len(other_sizes) >= _DECIDING_PICTURES and len(set(other_sizes)) == 1:
            break
    raise first_error or ValueError("pictures: expected at least one view")
