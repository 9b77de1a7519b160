"""Read the target that a description states itself, or that stands in a file of Kalibr's.

Kalibr's `target.yaml` has `target_type: 'aprilgrid'`, `tagCols`, `tagRows`, `tagSize` in m, and
`tagSpacing`, the gap between two tags in parts of a tag's side.
"""

from pathlib import Path
from typing import Any

from ..files import read_yaml
from ..targets import AbstractTarget, AprilGrid, target_from_dict


def read_target(folder: Path, content: dict[str, Any]) -> AbstractTarget:
    """Return the target of a data set.

    Args:
        folder: of the data set, to which the name of a file is relative.
        content: the entry `target`, as `schemas.target` defines it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: an entry is wrong; the message names it, and Kalibr's file if it is there.
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
        ValueError: another kind of target, or an entry is missing or wrong.
    """
    from ..schemas.external_formats import KALIBR_TARGET_SCHEMA
    from ..schemas.validation import validate_content

    content = read_yaml(path)
    kind = content.get("target_type")
    if kind != "aprilgrid":
        raise ValueError(f"{path}: target_type: expected 'aprilgrid', found {kind!r}")
    grid = validate_content(content, KALIBR_TARGET_SCHEMA, path)
    try:
        return AprilGrid(grid.tagRows, grid.tagCols, grid.tagSize, grid.tagSpacing)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
