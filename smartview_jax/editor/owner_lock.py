"""Let one editor at a time work on a file, and say who the other one is."""

import json
import os
import socket
from pathlib import Path
from typing import Any


class OwnerLock:
    """A file beside the edited one that names the process that edits it.

    A lock whose process has ended on this machine is stale and taken over. On another machine that
    cannot be seen, so such a lock is kept and the message says which file to remove.
    """

    def __init__(self, path: Path):
        """Take the lock.

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
                raise BlockingIOError(_refusal(path, owner)) from None
            path.unlink(missing_ok=True)
            # A third editor may have been quicker; then it is the owner.
            try:
                self._create()
            except FileExistsError:
                raise BlockingIOError(_refusal(path, self._read())) from None

    def _create(self) -> None:
        """Create the file with the name of this process, or raise a FileExistsError."""
        # O_EXCL: exactly one of several processes makes the file.
        descriptor = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        try:
            with os.fdopen(descriptor, "w") as file:
                json.dump(_this_process(), file)
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            # A full disk: half a name would be a lock that nobody is known to hold.
            self.path.unlink(missing_ok=True)
            raise

    def _read(self) -> dict[str, Any]:
        """Return what the lock says about its owner; empty if it says nothing readable."""
        try:
            content = json.loads(self.path.read_text())
            return content if isinstance(content, dict) else {}
        except (OSError, ValueError):
            return {}

    def release(self) -> None:
        """Remove the lock; a second call does nothing."""
        # Another editor may have taken over a lock that looked stale to it; that is not ours to
        # remove.
        if self._read() == _this_process():
            self.path.unlink(missing_ok=True)


def _this_process() -> dict[str, Any]:
    """Return what names this process."""
    return {"pid": os.getpid(), "host": socket.gethostname(), "started": _start_of(os.getpid())}


def _start_of(pid: int) -> str | None:
    """Return when a process started, in the kernel's own count; None where that is not known."""
    # The number of a process is given again to a later one; its start tells the two apart.
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _is_stale(owner: dict[str, Any]) -> bool:
    """Return whether the owner of a lock is a process of this machine that has ended."""
    pid = owner.get("pid")
    if not isinstance(pid, int):
        # The owner was killed between making the file and writing to it.
        return not owner
    if owner.get("host") != socket.gethostname():
        return False
    try:
        os.kill(pid, 0)
    # Signal 0 reaches a process that exists without disturbing it.
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return owner.get("started") != _start_of(pid)


def _refusal(path: Path, owner: dict[str, Any]) -> str:
    """Return the message for a file that another editor has open."""
    edited = path.with_suffix("")
    return (
        f"{edited} is open in another editor: process {owner.get('pid', '?')} on "
        f"{owner.get('host', '?')}. Close it there; if it is gone, remove {path}"
    )
