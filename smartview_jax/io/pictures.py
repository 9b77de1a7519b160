"""Make a data set from picture files and robot poses; every importer of pictures uses this."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import mount_frames
from ..dataset import Dataset
from ..detection import DetectionLimits, consistent_ordering, left_out_note
from ..geometry import PoseLike, as_se3, host_matrices
from ..targets import AbstractTarget, CircleGrid, StackedTarget
from .picture_detections import detect_views


def dataset_from_pictures(
    pictures: Mapping[str, Sequence[Path]],
    base_from_tool: PoseLike,
    target: AbstractTarget,
    mount: str = "eye_in_hand",
    image_size: tuple[int, int] | None = None,
    bad_views: str = "raise",
    masked_views: Mapping[str, str] | None = None,
    progress: Callable[[str], None] | None = None,
    cache: Path | None = None,
    holder_from_world: PoseLike | None = None,
    board_heights: Mapping[str, int] | None = None,
    detection_limits: DetectionLimits | None = None,
) -> Dataset:
    """Make a data set from pictures by detecting the target in each of them.

    Args:
        pictures: files by view id: one, or one for each height of a `StackedTarget`.
        base_from_tool: `(views)` robot poses, in the order of `pictures`.
        target: the calibration target in the pictures.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_size: width and height that every picture must have, px; by default the first one's.
        bad_views: `"raise"` an error for a picture that cannot be read, or `"mask"` its view.
        masked_views: reason by view id, for views already known to be unusable.
        progress: called with a line of text for each step of the work.
        cache: a `detections.csv` to read if it belongs to these pictures, or else to write.
        holder_from_world: approximate pose of the target: `base_from_world`, or `tool_from_world`
            for a camera that stands beside the arm. It decides the orientation of a pattern that
            looks the same when rotated; by default the orientation with the smallest rotation.
        board_heights: index of the height of a `StackedTarget` in the only picture of a view, by
            view id; by default every view has a picture for each height.
        detection_limits: as in `load_dataset`.

    Raises:
        FileNotFoundError: a picture is missing.
        ValueError: a picture cannot be read or has another size, none of them shows the target, or
            a circle grid has rows or columns that none of them shows.
    """
    views, poses = list(pictures), as_se3(base_from_tool)
    mount_frames(mount)
    detections, image_size = detect_views(
        pictures, target, image_size, bad_views, progress, cache, board_heights, detection_limits
    )
    undetected = {
        view: detection.reason or "no point of the target was seen"
        for view, detection in detections.items()
        if not detection.visible.any()
    }
    if len(undetected) == len(views):
        raise ValueError(
            f"{next(iter(pictures.values()))[0].parent}: the target was found in none of "
            f"{len(views)} views ({next(iter(undetected.values()))}): is it a {target!r}?"
        )
    pixels = np.stack([detections[view].pixels for view in views])
    _refuse_undetected_rows(pixels, target, next(iter(pictures.values()))[0].parent)
    consistent_pixels, note = _consistent_numbering(
        pixels, target, poses, mount, image_size, holder_from_world
    )
    left_out = {view: found.left_out for view, found in detections.items() if found.left_out}
    notes = (*((note,) if note else ()), *left_out_note(left_out))
    if progress is not None:
        for text in notes:
            progress(text)
    return Dataset.from_arrays(
        target.points,
        consistent_pixels,
        poses,
        image_size,
        view_ids=views,
        mount=mount,
        bad_views=bad_views,
        masked_views=list({**undetected, **(masked_views or {})}.items()),
        pictures=[_shown_picture(pictures[view], detections[view].visible) for view in views],
        target=target,
        notes=notes,
    )


def numbered_pictures(
    folder: Path, pattern: str, numbers: Sequence[int], poses_path: Path
) -> dict[str, list[Path]]:
    """Return the picture of each numbered view, by view id.

    Args:
        folder: folder that the pattern is relative to.
        pattern: file name with `{view}`, formatted by the number.
        numbers: numbers of the views.
        poses_path: file of the poses, for the error message.

    Raises:
        ValueError: a pattern without `{view}`, or pictures without a pose.
    """
    if "{view" not in pattern:
        raise ValueError(f"pictures: expected a name with {{view}} in it, found {pattern!r}")
    files = {str(number): [folder / pattern.format(view=number)] for number in numbers}
    refuse_unmatched_pictures(files, folder / re.sub(r"{view[^}]*}", "*", pattern), poses_path)
    return files


def refuse_unmatched_pictures(
    pictures: Mapping[str, Sequence[Path]], pattern: Path, poses_path: Path
) -> None:
    """Raise a ValueError that names the pictures that match a pattern but have no pose."""
    matched = {path for paths in pictures.values() for path in paths}
    parent = pattern.parent
    unmatched = sorted(p.name for p in parent.glob(pattern.name) if p not in matched)
    if unmatched:
        raise ValueError(
            f"{poses_path}: no pose for the picture {', '.join(unmatched[:5])} of {parent}: "
            f"a row is missing, or a picture too many"
        )


def _shown_picture(paths: Sequence[Path], visible: Bool[np.ndarray, " points"]) -> Path:
    """Return the picture of the first height at which a point was found, to be drawn on."""
    if len(paths) == 1:
        return paths[0]
    # The points of a stacked target are in the order of the heights. `argmax` finds the first True.
    return paths[int(np.argmax(visible.reshape(len(paths), -1).any(axis=1)))]


def _refuse_undetected_rows(
    pixels: Float[np.ndarray, "views points 2"], target: AbstractTarget, folder: Path
) -> None:
    """Raise a ValueError if no view shows some rows or columns of a circle grid.

    Circles carry no numbers. If the stated grid is larger than the real one, every view of the
    whole real grid looks like a view of a part of the stated one; nothing else reveals the mistake.
    """
    grid = target.board if isinstance(target, StackedTarget) else target
    if not isinstance(grid, CircleGrid):
        return
    # Whether any view, at any height, shows the circle at each row and column.
    visible = np.isfinite(pixels).all(axis=-1).reshape(-1, grid.rows, grid.columns).any(axis=0)
    rows, columns = (len(np.unique(indices)) for indices in np.nonzero(visible))
    if (rows, columns) != (grid.rows, grid.columns):
        raise ValueError(
            f"{folder}: of {grid.rows} rows and {grid.columns} columns of circles, {rows} and "
            f"{columns} are seen in any of {len(pixels)} views: is it a grid of {rows} x {columns}?"
        )


def _consistent_numbering(
    pixels: Float[np.ndarray, "views points 2"],
    target: AbstractTarget,
    poses: SE3,
    mount: str,
    image_size: tuple[int, int],
    holder_from_world: PoseLike | None,
) -> tuple[Float[np.ndarray, "views points 2"], str]:
    """Return pixels in one numbering of the points for all views, and a note on how it was chosen.

    A pattern that looks the same when rotated has several numberings, and the detector may take
    another one in each picture; the robot's rotations decide which of them agree.
    """
    stacked = isinstance(target, StackedTarget)
    board = target.board if stacked else target
    symmetries = board.symmetries
    if len(symmetries) == 1:
        return pixels, ""
    rough_rotation = None
    if holder_from_world is not None:
        rough_rotation = host_matrices(as_se3(holder_from_world))[:3, :3]
        if stacked and not board.y_up:
            # The order refers to the board's own frame, which differs from the stack's frame by a
            # half rotation about x: diag(1, -1, -1).
            rough_rotation = rough_rotation @ np.diag([1.0, -1.0, -1.0])
    # Each picture has an order of its own: at another height the detector may start at another
    # corner. So the heights of a view are separate rows here, `(views * heights, points, 2)`.
    board_pixels = pixels.reshape(-1, len(board.points), 2)
    # The rotations of `mount_from_holder`, whose inverse are the transposes.
    rotations = host_matrices(poses)[:, :3, :3]
    if mount_frames(mount)[0] == "tool":
        rotations = rotations.transpose(0, 2, 1)
    ordering = consistent_ordering(
        board_pixels,
        np.asarray(np.isfinite(board_pixels).all(axis=-1)),
        board.points,
        symmetries,
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
