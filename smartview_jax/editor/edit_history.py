"""Keep the document of a session with what can be undone and redone, in its journal if it has one.

Every change is on disk before it takes effect, and a lock keeps other editors away.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..argument_checks import errors_at, nearest_name
from .document import Document, apply_change
from .journal import Journal
from .owner_lock import OwnerLock


def _with_names(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return an entry of a journal with valid names; earlier versions accepted more."""
    changes = entry.get("changes")
    if entry.get("do") == "several" and isinstance(changes, list):
        repaired = [_with_names(part) if isinstance(part, dict) else part for part in changes]
        return {**entry, "changes": repaired}
    name = entry.get("name")
    return {**entry, "name": nearest_name(name)} if isinstance(name, str) else entry


class EditHistory:
    """A document with its history of changes, undone ones included.

    Attributes:
        path: path of the journal; None for a history in memory only.
        notes: remarks from the opening of the journal.
    """

    def __init__(self, model_path: Path | None, header: Mapping[str, Any]):
        """Begin a history, or resume the one in the journal next to a model's file.

        Args:
            model_path: path of the model's file; None keeps nothing on disk.
            header: the views that the changes refer to; see `Journal`.

        Raises:
            ValueError: a model file without a journal, a journal of other views, or a broken
                journal; the message names the line.
            BlockingIOError: the file is open in another editor, which the message names.
        """
        self.document: Document = Document()
        # Documents share their common parts, so keeping all of them costs little.
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
        """Take the file's lock and replay the changes of its journal."""
        self.path = model_path.with_name(model_path.name + ".journal")
        if model_path.is_file() and not self.path.is_file():
            raise ValueError(
                f"{model_path} exists without its journal {self.path.name}: without the clicks it "
                "cannot be edited; choose another file"
            )
        # The lock comes first: a journal that is being written must not be read.
        self._lock = OwnerLock(model_path.with_name(model_path.name + ".lock"))
        try:
            self._journal = Journal(self.path, header)
            for number, entry in enumerate(self._journal.entries, start=2):
                # A journalled change can fail only if someone edited the file.
                with errors_at(f"{self.path}: line {number}"):
                    self._apply(_with_names(entry))
        # A session that failed to open must not keep others from opening the file.
        except BaseException:
            self.close()
            raise
        if self._journal.cut_off:
            self.notes.append(
                f"the last change is lost: only {self._journal.cut_off} bytes of it were written"
            )

    def _apply(self, entry: Mapping[str, Any]) -> None:
        """Apply an entry of the journal to the history in memory."""
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
        """Add a new document; it replaces the changes that could be redone."""
        self._documents[self._position + 1 :] = [changed]
        self._position += 1
        self.document = changed

    def _write(self, entry: Mapping[str, Any]) -> None:
        """Append an entry to the journal, if there is one."""
        if self._journal is not None:
            self._journal.append(entry)

    def change(self, change: Mapping[str, Any], changed: Document) -> None:
        """Keep a change and the resulting document.

        Raises:
            OSError: it cannot be written; nothing was changed.
        """
        # On disk first, so that no change is lost after it was confirmed.
        self._write(change)
        self._append(changed)

    def undo(self) -> bool:
        """Undo the last change; return whether there was one."""
        return self.can_undo and self._step({"undo": True})

    def redo(self) -> bool:
        """Redo the change that was undone last; return whether there was one."""
        return self.can_redo and self._step({"redo": True})

    def _step(self, entry: Mapping[str, Any]) -> bool:
        """Journal an undo or redo, then make it."""
        self._write(entry)
        self._apply(entry)
        return True

    def mark_saved(self, name: str) -> None:
        """Note that the document as it is now was saved to the model's file."""
        self._write({"saved": name})
        self._saved = self.document

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to undo."""
        return self._position > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a change to redo."""
        return self._position < len(self._documents) - 1

    @property
    def is_saved(self) -> bool:
        """Whether the model's file has all changes; the journal has them in any case."""
        return self._saved is not None and self._saved is self.document

    def close(self) -> None:
        """Release the file, so that another editor can open it."""
        # The journal before the lock, so that no other editor reads an unfinished line.
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        if self._lock is not None:
            self._lock.release()
            self._lock = None
