"""Read the target from a description, or from Kalibr's file that the description names.

Kalibr's `target.yaml` has `target_type: 'aprilgrid'`, `tagCols`, `tagRows`, `tagSize` in m, and
`tagSpacing`, the gap between two tags relative to the tag's side.
"""

from pathlib import Path
from typing import Any

from ..argument_checks import errors_at
from ..files import read_yaml
from ..targets import AbstractTarget, AprilGrid, target_from_dict


def read_target(folder: Path, content: dict[str, Any]) -> AbstractTarget:
    """Return the target of a data set.

    Args:
        folder: folder of the data set, to which a file name is relative.
        content: the entry `target`, as `schemas.target` defines it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a wrong entry; the message names it, and the file if it is in Kalibr's file.
    """
    if content.get("kind") != "aprilgrid" or content.get("file") is None:
        return target_from_dict({key: value for key, value in content.items() if value is not None})
    grid = read_april_grid(folder / content["file"])
    numbers = {name: getattr(grid, name) for name in ("rows", "columns", "size", "spacing")}
    given = {key: value for key, value in content.items() if key != "file" and value is not None}
    return target_from_dict({**given, **numbers})


def read_april_grid(path: str | Path) -> AprilGrid:
    """Read the `target.yaml` of Kalibr for an AprilGrid.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a different kind of target, or a missing or wrong entry.
    """
    from ..schemas.external_formats import KALIBR_TARGET_SCHEMA
    from ..schemas.validation import validate_content

    content = read_yaml(path)
    kind = content.get("target_type")
    if kind != "aprilgrid":
        raise ValueError(f"{path}: target_type: expected 'aprilgrid', found {kind!r}")
    grid = validate_content(content, KALIBR_TARGET_SCHEMA, path)
    with errors_at(path):
        return AprilGrid(grid.tagRows, grid.tagCols, grid.tagSize, grid.tagSpacing)
