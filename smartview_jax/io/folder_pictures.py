"""Find the picture of each view in a folder, by a pattern of their names.

A picture of a view that is being added (see `growing_dataset`) has a hidden name until the view is
complete.
"""

import re
import unicodedata
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypedDict

from ..detection import DetectionLimits
from ..targets import AbstractTarget, StackedTarget
from .csv_tables import Table
from .folder_description import DescribedFolder

PENDING_SUFFIX = ".pending"
"""The suffix of a picture that has no final name yet; its name also begins with a full stop."""


HEIGHT_COLUMN = "height"
"""The name of the column with the index of the board's height."""


class ImportOptions(TypedDict, total=False):
    """The fields of `LoadOptions` that importers of other formats have as keyword arguments."""

    bad_views: str
    progress: Callable[[str], None] | None
    detection_limits: DetectionLimits | None


class LoadOptions(NamedTuple):
    """The options of reading a folder, as in `load_dataset`.

    Attributes:
        bad_views: `"raise"` or `"mask"`.
        progress: called with a line of text for each step of the work.
        keep_detections: whether to write detections to the folder.
        detection_limits: limits of the check of detected points.
    """

    bad_views: str = "raise"
    progress: Callable[[str], None] | None = None
    keep_detections: bool = True
    detection_limits: DetectionLimits | None = None


def picture_files(
    described: DescribedFolder,
    pattern: str,
    view_ids: Sequence[str],
    target: AbstractTarget,
    board_heights: Mapping[str, int] | None = None,
) -> dict[str, list[Path]]:
    """Return the picture files of each view: one, or one for each height of a `StackedTarget`.

    Args:
        pattern: of the files' names, as `schemas.dataset` defines it.
        board_heights: index of the height in the only picture of a view; see `read_board_heights`.

    Raises:
        ValueError: a pattern without the height, or pictures without a pose.
    """
    folder, table = described.folder, described.view_table
    heights = range(target.height_count)
    if board_heights is None and len(heights) > 1 and "{height}" not in pattern:
        raise ValueError(
            f"{described.path}: pictures.pattern: {len(heights)} heights need {{height}} in it, "
            f"or a column height in {table.name} if every picture has its own pose"
        )
    spellings = _Spellings()
    files = {
        view: [
            spellings.standing(standing_path(folder / pattern.format(view=view, height=k)))
            for k in (heights if board_heights is None else [board_heights[view]])
        ]
        for view in view_ids
    }
    # A glob over the same names finds pictures without a pose. Adjacent placeholders become one
    # "*", because "**" has a meaning of its own in a glob.
    escaped = re.sub(r"([*?[])", r"[\1]", pattern)
    glob_pattern = re.sub(r"(\*\*+)", "*", re.sub(r"{(view|height)}", "*", escaped))
    refuse_unmatched_pictures(files, folder / glob_pattern, table)
    return files


class _Spellings:
    """The names in folders by their letters, which Unicode composes in two ways.

    Archives that a Mac wrote have letters apart from their accents, tables have them in one.
    """

    def __init__(self) -> None:
        self._folders: dict[Path, dict[str, Path]] = {}

    def standing(self, path: Path) -> Path:
        """Return the path of a file whose name is composed in either way; the path if none is."""
        if path.name.isascii() or path.exists():
            return path
        folder = path.parent
        if folder not in self._folders:
            files = folder.iterdir() if folder.is_dir() else ()
            self._folders[folder] = {unicodedata.normalize("NFC", f.name): f for f in files}
        return self._folders[folder].get(unicodedata.normalize("NFC", path.name), path)


def numbered_pictures(
    folder: Path, pattern: str, numbers: Sequence[int], poses_path: Path
) -> dict[str, list[Path]]:
    """Return the picture of each numbered view, by view id; the pattern has `{view}` in it."""
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
            f"a missing row, or an extra picture{_lost_zeros(matched, unmatched)}"
        )


def _lost_zeros(wanted: Collection[Path], others: Sequence[str]) -> str:
    """Return a clause if a missing picture is there with leading zeros; else nothing."""
    missing = {path.stem.lstrip("0") for path in wanted if not path.exists()}
    shortened = [name for name in others if Path(name).stem.lstrip("0") in missing]
    if not shortened:
        return ""
    return f", or did a spreadsheet remove leading zeros from the names, such as {shortened[0]}?"


def pending_path(path: Path) -> Path:
    """Return the hidden path of a picture until its view is complete."""
    return path.with_name(f".{path.name}{PENDING_SUFFIX}")


def standing_path(path: Path) -> Path:
    """Return where a picture is: at its path, or at its hidden one."""
    # A process that was killed after it had added the row leaves the picture there.
    hidden = pending_path(path)
    return hidden if not path.exists() and hidden.exists() else path


def pending_pictures(folder: Path) -> list[Path]:
    """Return the final paths of all pictures under a folder that have a hidden one."""
    return [
        path.with_name(path.name[1 : -len(PENDING_SUFFIX)])
        for path in sorted(folder.rglob(f".*{PENDING_SUFFIX}"))
    ]


def read_board_heights(
    table: Table | None, target: AbstractTarget, view_ids: Sequence[str], suffix: str = ""
) -> dict[str, int] | None:
    """Return the index of the board's height by view; None if a view has a picture of each height.

    If the board is raised under a robot that does not move, a view has a picture for each height.
    If the robot instead goes through all its poses, the board is raised, and the robot repeats the
    poses (not exactly), every picture has its own row in the table of poses or joint readings, and
    the column `height` holds the index of the board's height:

        view,height,x,y,z,...
        first_0,0,...
        first_1,1,...

    Args:
        table: the table of poses, joint readings or picture times; None if the poses are in a file
            of another format, which has no further columns.
        target: only a `StackedTarget` has several heights.
    """
    if not isinstance(target, StackedTarget) or table is None:
        return None
    rows = {row["view"].removesuffix(suffix): row for row in table.rows}
    if HEIGHT_COLUMN not in next(iter(rows.values())):
        return None
    indices = [str(k) for k in range(len(target.heights))]
    for view in view_ids:
        if rows[view][HEIGHT_COLUMN] not in indices:
            raise ValueError(
                f"{table.path}: view {view}: {HEIGHT_COLUMN} is {rows[view][HEIGHT_COLUMN]!r}; "
                f"expected the index of one of the target's heights, 0 to {len(indices) - 1}"
            )
    return {view: int(rows[view][HEIGHT_COLUMN]) for view in view_ids}
