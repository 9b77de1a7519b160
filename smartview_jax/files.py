"""Reading and writing text files: safely, atomically, with errors that name the file."""

import os
import tempfile
from pathlib import Path
from typing import Any

import yaml


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a whole file or nothing: a temporary name beside it, then a rename.

    Folders that are missing are made. An interrupted run leaves the old file as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode("utf-8") if isinstance(content, str) else content
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
    return path


def read_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The mapping in a YAML (or JSON) file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not YAML, or not a mapping at the top level.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not readable as YAML: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping, found {type(content).__name__}")
    return content


def dump_yaml(content: dict[str, Any]) -> str:
    """YAML text that a person can read: keys in the given order, short lists on one line."""
    return yaml.dump(
        content, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True
    )
