"""Keep every change on disk before it is answered, so that no killed process loses one.

The journal is a text file with one JSON mapping per line: a header that names the views, and then
the changes in their order, undo and redo among them. A line counts once it is on the disk. A
process that is killed while it writes leaves a torn last line, which is cut off when the journal is
opened again. A file that no process of this kind can have left is refused and stays as it is.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FORMAT_VERSION = 1
"""Version of the format."""


class Journal:
    """An append-only file of changes.

    Attributes:
        entries: the changes in the journal when it was opened.
        cut_off: number of bytes of an incomplete last line that were removed.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]):
        """Open a journal, or begin one.

        Args:
            header: the views that the changes refer to; an existing journal must have the same.

        Raises:
            ValueError: the journal has other views, or a line before the last is broken.
        """
        self.path = path
        self.entries: list[dict[str, Any]] = []
        self.cut_off: int = 0
        path.parent.mkdir(parents=True, exist_ok=True)
        first = {"smartview_journal": FORMAT_VERSION, **header}
        lines = self._whole_lines(_line(first))
        # Compared after a round through JSON, in which tuples become lists.
        # A journal of other views would put clicks on pictures that they are not of.
        if lines:
            self._check_header(lines[0], json.loads(json.dumps(first)))
            self.entries = lines[1:]
        # Unbuffered: bytes that a full disk refused must not be written with the next change.
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 (it stays open until `close`)
        if not lines:
            self.append(first)
            _sync_folder(path.parent)

    def append(self, entry: Mapping[str, Any]) -> None:
        """Write an entry, and return when it is on the disk.

        Raises:
            OSError: the disk is full or failed; the file keeps only its earlier entries.
        """
        data = memoryview(_line(entry))
        descriptor = self._file.fileno()
        size = os.fstat(descriptor).st_size
        try:
            # A nearly full disk accepts a part of the bytes, and fails at the next call.
            while data:
                data = data[os.write(descriptor, data) :]
            # `fsync` protects against a power cut.
            os.fsync(descriptor)
        except BaseException:
            # A partial line would spoil the next entry.
            os.ftruncate(descriptor, size)
            raise

    def close(self) -> None:
        """Close the file; nothing is left to be written."""
        self._file.close()

    def _whole_lines(self, first: bytes) -> list[dict[str, Any]]:
        """Return the entries of all whole lines, after cutting off a torn last one.

        Raises:
            ValueError: a line is no change and was not torn; the file stays as it is.
        """
        if not self.path.is_file():
            return []
        data = self.path.read_bytes()
        # What follows the last line feed is torn, or lacks nothing but its own.
        *whole, rest = data.split(b"\n")
        entries = []
        for number, line in enumerate(whole, start=1):
            entry = _parsed(line)
            if entry is None and number == len(whole) and not rest and _may_be_torn(line, number):
                # A disk may write a file's end before its middle: this line has its end only.
                rest = line + b"\n"
                break
            if entry is None:
                raise ValueError(f"{self.path}: line {number} is not a change: {line[:60]!r}")
            entries.append(entry)
        if rest:
            # Only what was written here is cut off: no other program's file, and no line with the
            # line ends of another system.
            if b"\r" in rest or (not entries and not _may_be_torn(rest, 1, first)):
                raise ValueError(
                    f"{self.path}: line {len(entries) + 1} is not a change: {rest[:60]!r}"
                )
            self._mend_end(len(data) - len(rest), rest, entries)
        return entries

    def _mend_end(self, size: int, rest: bytes, entries: list[dict[str, Any]]) -> None:
        """Give a last line its lost end, or cut it off if it is torn."""
        # A part of a mapping is none, so that a mapping is all of the line.
        entry = _parsed(rest) if entries else None
        with open(self.path, "r+b") as file:
            if entry is not None:
                entries.append(entry)
                file.seek(size + len(rest))
                file.write(b"\n")
                file.flush()
            else:
                self.cut_off = len(rest)
                file.truncate(size)
            os.fsync(file.fileno())

    def _check_header(self, header: dict[str, Any], expected: dict[str, Any]) -> None:
        """Raise an error if a journal belongs to other views."""
        if "smartview_journal" not in header:
            raise ValueError(f"{self.path}: line 1: not a journal of the object-model editor")
        for key, value in expected.items():
            if header.get(key) != value:
                raise ValueError(
                    f"{self.path}: {key} differ: {header.get(key)!r} in the journal, {value!r} in "
                    "this session: choose another file, or the data set of that journal"
                )


def _line(entry: Mapping[str, Any]) -> bytes:
    return json.dumps(entry, allow_nan=False).encode() + b"\n"


def _may_be_torn(line: bytes, number: int, first: bytes = b"") -> bool:
    """Return whether a line that is no mapping may be a torn entry of this journal.

    Any line after the first may be. A torn first line has zeros where the disk did not write, or is
    the beginning of the `first` line; any other file is no journal.
    """
    return number > 1 or b"\0" in line or (line != b"" and first.startswith(line))


def _parsed(line: bytes) -> dict[str, Any] | None:
    """Return the mapping in a line, or None."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None


def _sync_folder(folder: Path) -> None:
    """Wait until a new file's name is on disk, if the system supports it."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        # Some file systems do not sync folders; the file itself is synced.
        pass
    finally:
        os.close(descriptor)
