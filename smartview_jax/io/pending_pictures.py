"""Name the pictures of views that are being added to a folder (see `growing_dataset`)."""

from pathlib import Path

PENDING_SUFFIX = ".pending"
"""The suffix of a picture that has no final name yet; its name also begins with a full stop."""


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
