"""Make a data set from picture files and robot poses, for all importers of pictures."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import mount_frames
from ..dataset import Dataset, evenly_spaced
from ..detection import consistent_ordering, left_out_note, read_picture, shown_instead
from ..geometry import PoseLike, as_se3, host_matrices
from ..targets import AbstractTarget, CircleGrid, StackedTarget
from .blurred_views import blur_notes
from .folder_pictures import LoadOptions
from .picture_detections import ShownTarget, detect_views

MAX_ASKED_PICTURES = 3
"""Largest number of pictures in which other boards are looked for if none shows the target."""


def dataset_from_pictures(
    pictures: Mapping[str, Sequence[Path]],
    base_from_tool: PoseLike,
    shown: ShownTarget,
    *,
    options: LoadOptions,
    masked_views: Mapping[str, str] | None = None,
    cache: Path | None = None,
) -> Dataset:
    """Make a data set from pictures by detecting the target in each of them.

    Args:
        pictures: files by view id: one, or one for each height of a `StackedTarget`.
        base_from_tool: `(views)` robot poses, in the order of `pictures`.
        options: how pictures are read; their `keep_detections` is not used.
        masked_views: reason by view id, for views already known to be unusable.
        cache: a `detections.csv` to read if it belongs to these pictures, and to write otherwise.

    Raises:
        FileNotFoundError: a picture is missing.
        ValueError: a picture is unreadable or has a wrong size, no picture shows the target, or
            some rows or columns of a circle grid are in no picture.
    """
    views, poses = list(pictures), as_se3(base_from_tool)
    target, progress = shown.target, options.progress
    mount_frames(shown.mount)
    detections, image_size = detect_views(pictures, shown, options, cache)
    undetected = {
        view: detection.reason or "no point of the target was seen"
        for view, detection in detections.items()
        if not detection.visible.any()
    }
    if len(undetected) == len(views):
        reason, instead = next(iter(undetected.values())), _shown_instead(pictures, target)
        raise ValueError(
            f"{next(iter(pictures.values()))[0].parent}: the target was found in none of "
            f"{len(views)} views"
            + (f": {instead} ({reason})" if instead else f" ({reason}): is it really a {target!r}?")
        )
    pixels = np.stack([detections[view].pixels for view in views])
    _refuse_undetected_rows(pixels, target, next(iter(pictures.values()))[0].parent)
    consistent_pixels, note = _consistent_numbering(pixels, shown, poses, image_size)
    left_out = {view: d.left_out for view, d in detections.items() if d.left_out}
    notes = (*((note,) if note else ()), *left_out_note(left_out), *blur_notes(detections))
    if progress is not None:
        for text in notes:
            progress(text)
    return Dataset.from_arrays(
        target.points,
        consistent_pixels,
        poses,
        image_size,
        view_ids=views,
        mount=shown.mount,
        bad_views=options.bad_views,
        masked_views=list({**undetected, **(masked_views or {})}.items()),
        pictures=[_shown_picture(pictures[view], detections[view].visible) for view in views],
        target=target,
        notes=notes,
    )


def _shown_instead(pictures: Mapping[str, Sequence[Path]], target: AbstractTarget) -> str:
    """Return what some pictures show instead of the target, as a clause; empty if nothing known."""
    paths = [path for view_paths in pictures.values() for path in view_paths]
    asked = evenly_spaced(len(paths), MAX_ASKED_PICTURES)
    shown = []
    for path in (paths[k] for k in asked):
        # A picture that cannot be read tells nothing; the reason of its view says so.
        with suppress(FileNotFoundError, ValueError):
            shown.append(read_picture(path))
    return shown_instead(shown, target.flat_board)


def _shown_picture(paths: Sequence[Path], visible: Bool[np.ndarray, " points"]) -> Path:
    """Return the picture to show: the first height at which a point was found."""
    if len(paths) == 1:
        return paths[0]
    # The points of a stacked target are in the order of the heights. `argmax` finds the first True.
    return paths[int(np.argmax(visible.reshape(len(paths), -1).any(axis=1)))]


def _refuse_undetected_rows(
    pixels: Float[np.ndarray, "views points 2"], target: AbstractTarget, folder: Path
) -> None:
    """Raise a ValueError if no view shows some rows or columns of a circle grid.

    Circles carry no numbers: if the stated grid is larger than the real one, every view of the real
    grid looks like a partial view of the stated grid, and nothing else reveals the mistake.
    """
    grid = target.flat_board
    if not isinstance(grid, CircleGrid):
        return
    # Whether any view, at any height, shows the circle at each row and column.
    visible = np.isfinite(pixels).all(axis=-1).reshape(-1, grid.rows, grid.columns).any(axis=0)
    rows, columns = (len(np.unique(indices)) for indices in np.nonzero(visible))
    if (rows, columns) != (grid.rows, grid.columns):
        raise ValueError(
            f"{folder}: expected a grid of {grid.rows} x {grid.columns} circles, but the "
            f"{len(pixels)} views show only {rows} rows and {columns} columns: is it a grid of "
            f"{rows} x {columns}?"
        )


def _consistent_numbering(
    pixels: Float[np.ndarray, "views points 2"],
    shown: ShownTarget,
    poses: SE3,
    image_size: tuple[int, int],
) -> tuple[Float[np.ndarray, "views points 2"], str]:
    """Return pixels with one numbering of the points in all views, and a note on its choice.

    A pattern that looks the same when rotated has several numberings, and the detector may choose
    differently in each picture; the robot's rotations decide which choices agree.
    """
    target, mount, holder_from_world = shown.target, shown.mount, shown.holder_from_world
    stacked = isinstance(target, StackedTarget)
    board = target.flat_board
    symmetries = board.symmetries
    if len(symmetries) == 1:
        return pixels, ""
    rough_rotation = None
    if holder_from_world is not None:
        rough_rotation = host_matrices(as_se3(holder_from_world))[:3, :3]
        if stacked and not board.y_up:
            # The numbering refers to the board's frame, which differs from the stack's frame by
            # half a turn about x: diag(1, -1, -1).
            rough_rotation = rough_rotation @ np.diag([1.0, -1.0, -1.0])
    # The detector may start at a different corner in each picture, so the heights of a view are
    # separate rows here, `(views * heights, points, 2)`.
    board_pixels = pixels.reshape(-1, len(board.points), 2)
    # The rotations of `mount_from_holder`.
    rotations = host_matrices(poses)[:, :3, :3]
    if mount_frames(mount)[0] == "tool":
        rotations = rotations.transpose(0, 2, 1)
    ordering = consistent_ordering(
        board_pixels,
        np.asarray(np.isfinite(board_pixels).all(axis=-1)),
        board,
        np.repeat(rotations, len(board_pixels) // len(pixels), axis=0),
        image_size,
        mount_frames(mount)[1],
        rough_rotation,
    )
    renumbered = [
        row_pixels[symmetries[k]]
        for row_pixels, k in zip(board_pixels, ordering.symmetry, strict=True)
    ]
    return np.stack(renumbered).reshape(pixels.shape), ordering.message
