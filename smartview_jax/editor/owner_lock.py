"""Lock a file against other editors, and name the editor that has it open."""

import json
import os
import socket
from pathlib import Path
from typing import Any


class OwnerLock:
    """A file next to the edited one that names the process that edits it.

    A lock whose process on this machine has ended is stale and taken over. Processes of other
    machines cannot be checked, so their locks are kept and the message says which file to remove.
    """

    def __init__(self, path: Path, program: str = "editor"):
        """Take the lock.

        Args:
            path: of the lock, which is the edited file's with a further suffix.
            program: kind of program, for messages.

        Raises:
            BlockingIOError: another process, or another session of this one, edits the file.
        """
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._create()
        except FileExistsError:
            owner = self._read()
            if not _is_stale(owner):
                raise BlockingIOError(_refusal(path, owner, program)) from None
            path.unlink(missing_ok=True)
            # A third editor may have taken the lock in between.
            try:
                self._create()
            except FileExistsError:
                raise BlockingIOError(_refusal(path, self._read(), program)) from None

    def _create(self) -> None:
        """Create the file that names this process, or raise a FileExistsError."""
        # O_EXCL: exactly one of several processes creates the file.
        descriptor = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        try:
            with os.fdopen(descriptor, "w") as file:
                json.dump(_this_process(), file)
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            # On a full disk an incomplete file would be a lock without an owner.
            self.path.unlink(missing_ok=True)
            raise

    def _read(self) -> dict[str, Any]:
        """Return the owner in the lock; empty if it is not readable."""
        try:
            content = json.loads(self.path.read_text())
            return content if isinstance(content, dict) else {}
        except (OSError, ValueError):
            return {}

    def release(self) -> None:
        """Remove the lock; a second call does nothing."""
        # Another editor may have taken over the lock because it looked stale.
        if self._read() == _this_process():
            self.path.unlink(missing_ok=True)


def _this_process() -> dict[str, Any]:
    return {"pid": os.getpid(), "host": socket.gethostname(), "started": _start_of(os.getpid())}


def _start_of(pid: int) -> str | None:
    """Return the start time of a process, in the kernel's ticks; None if unknown."""
    # Process ids are reused; the start time tells two such processes apart.
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _is_stale(owner: dict[str, Any]) -> bool:
    """Return whether the owner of a lock is a process of this machine that has ended."""
    pid = owner.get("pid")
    if not isinstance(pid, int):
        # Empty: the owner was killed between creating the file and writing to it.
        return not owner
    if owner.get("host") != socket.gethostname():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return owner.get("started") != _start_of(pid)


def _refusal(path: Path, owner: dict[str, Any], program: str) -> str:
    """Return the message for a file that another program has open."""
    edited = path.with_suffix("")
    return (
        f"{edited} is open in another {program}: process {owner.get('pid', '?')} on "
        f"{owner.get('host', '?')}. Close it there; if it no longer runs, remove {path}"
    )
