"""Keep the document of a session with what can be undone and redone, in its journal if it has one.

Every change is on the disk before it counts, and the journal's lock keeps other editors away.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..argument_checks import nearest_name
from .document import Document, apply_change
from .journal import Journal
from .owner_lock import OwnerLock


def _with_names(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return an entry of a journal with names; earlier versions took some that are none now."""
    changes = entry.get("changes")
    if entry.get("do") == "several" and isinstance(changes, list):
        mended = [_with_names(one) if isinstance(one, dict) else one for one in changes]
        return {**entry, "changes": mended}
    name = entry.get("name")
    return {**entry, "name": nearest_name(name)} if isinstance(name, str) else entry


class EditHistory:
    """A document with the earlier ones that led to it, and those that were undone.

    Attributes:
        document: as it is now.
        path: of the journal; None for a history that is kept in memory only.
        notes: sentences on what was found when the journal was opened.
    """

    def __init__(self, model_path: Path | None, header: Mapping[str, Any]):
        """Begin a history, or go on where the journal beside a model's file ends.

        Args:
            model_path: of the model's file; None keeps nothing on disk.
            header: what the changes refer to; see `Journal`.

        Raises:
            ValueError: a model's file without a journal, a journal of something else, or one that
                is broken; the line is named.
            BlockingIOError: the file is open in another editor, which the message names.
        """
        self.document: Document = Document()
        # Documents share what they have in common, so that keeping all of them costs little.
        self._documents: list[Document] = [self.document]
        self._position = 0
        self._saved: Document | None = None
        self.notes: list[str] = []
        self.path: Path | None = None
        self._lock: OwnerLock | None = None
        self._journal: Journal | None = None
        if model_path is not None:
            self._open(model_path, header)

    def _open(self, model_path: Path, header: Mapping[str, Any]) -> None:
        """Take the file's lock and repeat the changes of its journal."""
        self.path = model_path.with_name(model_path.name + ".journal")
        if model_path.is_file() and not self.path.is_file():
            raise ValueError(
                f"{model_path} exists, and its journal {self.path.name} does not: the clicks that "
                "it was made from are gone, so it cannot be edited; choose another file"
            )
        # The lock comes first: a second editor must not even read a journal that is being written.
        self._lock = OwnerLock(model_path.with_name(model_path.name + ".lock"))
        try:
            self._journal = Journal(self.path, header)
            for number, entry in enumerate(self._journal.entries, start=2):
                # A line that was accepted once is accepted again, unless someone edited the file.
                try:
                    self._apply(_with_names(entry))
                except ValueError as error:
                    raise ValueError(f"{self.path}: line {number}: {error}") from None
        # Or a session that could not be opened would keep others from opening it.
        except BaseException:
            self.close()
            raise
        if self._journal.cut_off:
            self.notes.append(
                f"the last change was torn ({self._journal.cut_off} bytes) and is cut off"
            )

    def _apply(self, entry: Mapping[str, Any]) -> None:
        """Change the history in memory by one entry of the journal."""
        if "undo" in entry:
            self._position = max(self._position - 1, 0)
        elif "redo" in entry:
            self._position = min(self._position + 1, len(self._documents) - 1)
        elif "saved" in entry:
            self._saved = self.document
        else:
            self._append(apply_change(self.document, entry))
        self.document = self._documents[self._position]

    def _append(self, changed: Document) -> None:
        """Go on to a new document; a new change ends what could be redone."""
        self._documents[self._position + 1 :] = [changed]
        self._position += 1
        self.document = changed

    def _write(self, entry: Mapping[str, Any]) -> None:
        """Append an entry to the journal, if there is one."""
        if self._journal is not None:
            self._journal.append(entry)

    def change(self, change: Mapping[str, Any], changed: Document) -> None:
        """Keep a change and the document that it led to.

        Raises:
            OSError: it cannot be written; nothing was changed.
        """
        # On the disk before in memory: what was answered is never lost.
        self._write(change)
        self._append(changed)

    def undo(self) -> bool:
        """Take back the last change; return whether there was one."""
        return self.can_undo and self._step({"undo": True})

    def redo(self) -> bool:
        """Make the change again that was taken back last; return whether there was one."""
        return self.can_redo and self._step({"redo": True})

    def _step(self, entry: Mapping[str, Any]) -> bool:
        """Write a step back or forth, and then make it."""
        self._write(entry)
        self._apply(entry)
        return True

    def mark_saved(self, name: str) -> None:
        """Note that the model's file of some name has the document as it is now."""
        self._write({"saved": name})
        self._saved = self.document

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to take back."""
        return self._position > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a change to make again."""
        return self._position < len(self._documents) - 1

    @property
    def is_saved(self) -> bool:
        """Whether the model's file has all changes; the journal has them in any case."""
        return self._saved is not None and self._saved is self.document

    def close(self) -> None:
        """Let go of the file, so that another editor can open it."""
        # The journal before the lock, or another editor could read an unfinished line.
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        if self._lock is not None:
            self._lock.release()
            self._lock = None
