"""Add views to a data-set folder one at a time, each as a picture and a row that appear together.

A folder has two files for each view, and no file system renames two files at once. So the table of
poses alone decides which views exist: the picture is first written under a hidden name
(`pending_path`), then the table with the new row replaces the old one, then the picture gets its
final name. Readers take the picture by its hidden name as long as it has no other
(`standing_path`). A process that is killed at any moment leaves either neither of the two or both.
"""

import contextlib
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxlie import SE3
from jaxtyping import UInt8

from ..argument_checks import require_readable
from ..files import read_yaml, write_atomically
from ..geometry import as_se3, host_matrices
from .csv_tables import read_table, refuse_out_of_range, row_text
from .folder_description import DESCRIPTION_FILE, FolderDescription, read_folder_description
from .folder_pictures import PENDING_SUFFIX, pending_path, pending_pictures
from .pose_format import COMMANDED_DIRECTION, FORMAT_COLUMN, PoseFormat, table_format
from .table_text import VIEW_COLUMN

VIEW_PREFIX = "v"
"""The first letter of new views' names, before a number."""


class GrowingDataset:
    """A data-set folder to which views are added, by one thread at a time.

    Attributes:
        folder: the folder, with a `dataset.yaml` and a table of poses, which may be empty.
        description: target, mount and size of the pictures.
        table: path of the table of poses.
        lock: held while a view is added; hold it while the folder is read by another thread.
        pose_format: format of the table.
    """

    def __init__(self, folder: str | os.PathLike[str]):
        """Open a folder, and complete the view that a killed process was adding.

        Raises:
            FileNotFoundError: the folder has no description or no table.
            ValueError: a wrong description, or a table to which no rows can be added.
        """
        self.folder: Path = Path(folder)
        self.description: FolderDescription = read_folder_description(self.folder)
        self.lock: threading.RLock = threading.RLock()
        content = read_yaml(self.folder / DESCRIPTION_FILE)
        self.table: Path
        self.table, self._pattern = self._checked(content)
        table = read_table(self.table, (VIEW_COLUMN,))
        self._header = table.written_header
        # The header alone states the format; the first row only has its names.
        rows = table.rows or [dict.fromkeys(self._header, "")]
        self.pose_format: PoseFormat = table_format(self.table, rows, content["poses"])
        self._refuse_other_columns()
        self._names = [row[VIEW_COLUMN] for row in table.rows]
        self._last: list[Path] = []
        self._complete(pending_pictures(self.folder))
        self._remove_unfinished_files()

    def __enter__(self) -> "GrowingDataset":
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the hidden name of the last picture."""
        with self.lock:
            self._complete(self._last)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the views in the table."""
        return tuple(self._names)

    def next_name(self) -> str:
        """Return the name that the next view gets by default: v1, v2, ..."""
        # After the number of views, so that a name says how many there were.
        numbers = range(1 + len(self._names), 2 + 2 * len(self._names))
        names = (f"{VIEW_PREFIX}{k}" for k in numbers)
        return next(name for name in names if name not in self._names)

    def add(
        self, picture: UInt8[np.ndarray, "..."], base_from_tool: SE3, name: str | None = None
    ) -> str:
        """Add a view, and return its name.

        Args:
            picture: grey or in OpenCV's colour order, of the size in the description.
            name: a new name; by default `next_name()`.

        Raises:
            ValueError: a name that is taken or is none, a picture of another size or that cannot
                be encoded, or a pose that could not be read back; nothing is written.
            OSError: the disk is full or cannot be written to; the folder is as before.
        """
        with self.lock:
            self._complete(self._last)
            view = self.next_name() if name is None else name
            require_readable("view", [view])
            if view in self._names:
                raise ValueError(f"view {view}: exists already in {self.table}")
            self._require_size(picture)
            row = self._row(view, base_from_tool)
            path = self._picture_path(view)
            encoded, data = cv2.imencode(path.suffix, picture)
            if not encoded:
                raise ValueError(f"{path}: OpenCV writes no pictures named *{path.suffix}")
            text = self.table.read_bytes().decode("utf-8-sig")
            end = "" if text.endswith("\n") else "\n"
            self._last = [path]
            write_atomically(pending_path(path), data.tobytes())
            # From here on the view exists.
            write_atomically(self.table, f"{text}{end}{row}")
            self._names.append(view)
            _give_final_name(path)
            return view

    def _checked(self, content: Mapping[str, Any]) -> tuple[Path, str]:
        """Return the table and the pattern of the pictures; raise where no view can be added."""
        path = self.folder / DESCRIPTION_FILE
        poses, pictures = content.get("poses"), content.get("pictures")
        if poses is None or pictures is None:
            missing = "poses" if poses is None else "pictures"
            raise ValueError(f"{path}: entry '{missing}' is missing: views need both")
        for entry in ("rows", "picture_times"):
            if poses.get(entry) is not None:
                raise ValueError(
                    f"{path}: poses.{entry}: remove this entry to add views to the folder"
                )
        if content.get("joints") is not None:
            raise ValueError(f"{path}: joints: views are added with poses only")
        pattern = pictures["pattern"]
        if "{height}" in pattern:
            raise ValueError(f"{path}: pictures.pattern: a view is added with a single picture")
        table = self.folder / poses["file"]
        if table.suffix == ".json":
            raise ValueError(f"{table}: rows are added to CSV tables only")
        return table, pattern

    def _refuse_other_columns(self) -> None:
        """Raise a ValueError for a table with columns that a new row would leave empty."""
        known = {VIEW_COLUMN, FORMAT_COLUMN, *self.pose_format.columns}
        others = [column for column in self._header if column not in known]
        first_line = self.table.read_bytes().decode("utf-8-sig").split("\n", 1)[0].strip()
        # A table as a spreadsheet writes it, with semicolons and decimal commas, is read but not
        # continued.
        if others or first_line != ",".join(self._header):
            raise ValueError(
                f"{self.table}: expected the header "
                f"{','.join((VIEW_COLUMN, *self.pose_format.columns))} to add rows, found "
                f"{first_line!r}"
            )

    def _require_size(self, picture: np.ndarray) -> None:
        """Raise a ValueError for a picture of another size than the description states."""
        width, height = self.description.image_size
        if picture.shape[:2] != (height, width):
            size = f"[{picture.shape[1]}, {picture.shape[0]}]"
            raise ValueError(
                f"the camera's pictures have {picture.shape[1]} x {picture.shape[0]} px, "
                f"{self.folder / DESCRIPTION_FILE} states {width} x {height}: write image_size: "
                f"{size} there"
            )

    def _row(self, view: str, base_from_tool: SE3) -> str:
        form = self.pose_format
        pose = as_se3(base_from_tool)
        refuse_out_of_range(self.table, np.asarray(pose.translation())[None], [view])
        if form.direction != COMMANDED_DIRECTION:
            pose = as_se3(np.linalg.inv(host_matrices(pose)))
        numbers = form.codec.encode(pose, *form.units)
        # Read back here, so that no row is written that the readers refuse.
        form.codec.decode(numbers[None], *form.units, labels=[view])
        fields: dict[str, object] = dict(zip(form.columns, map(float, numbers), strict=True))
        fields |= {VIEW_COLUMN: view, FORMAT_COLUMN: form.codec.name}
        return row_text([fields[column] for column in self._header])

    def _picture_path(self, view: str) -> Path:
        return self.folder / self._pattern.format(view=view)

    def _remove_unfinished_files(self) -> None:
        """Remove what a killed process left of files that it was writing."""
        # As `write_atomically` names them: after the file, with a random end.
        unfinished = [*self.folder.rglob(f"..*{PENDING_SUFFIX}.*")]
        unfinished += self.table.parent.glob(f".{self.table.name}.*")
        for path in unfinished:
            path.unlink(missing_ok=True)

    def _complete(self, pictures: Sequence[Path]) -> None:
        """Give pictures their final names, and remove those whose row was never written."""
        views = {self._picture_path(view) for view in self._names}
        for path in pictures:
            if path in views and not path.exists():
                os.replace(pending_path(path), path)
            else:
                pending_path(path).unlink(missing_ok=True)
        self._last = []


def _give_final_name(path: Path) -> None:
    """Let a pending picture be found by its final name too."""
    # A second name instead of another one: a reader that has just found the hidden name still finds
    # the picture there. Some file systems have no second names.
    try:
        os.link(pending_path(path), path)
    except OSError:
        with contextlib.suppress(FileNotFoundError):
            os.replace(pending_path(path), path)
