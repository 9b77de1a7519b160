"""Read the measured misses of a stylus: the vectors from the points to the tip.

CSV, with or without z:

    view,x_mm,y_mm
    v1,0.2,-0.4

or YAML:

    unit: mm
    misses:
      v1: [0.2, -0.4]

Misses are measured tip minus point, in the world's axes.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .. import schemas
from ..evaluation import MAX_MISS
from ..geometry import LENGTH_UNITS
from .csv_tables import parse_numbers, read_table


def read_misses(
    path: str | Path, names: Sequence[str], progress: Callable[[str], None] | None = None
) -> Float[np.ndarray, "touches _"]:
    """Return the misses of the named touches, m: x and y, or x, y and z.

    Args:
        path: a file ending in `.csv`, `.yaml` or `.yml`.
        names: names of the touches; the file must have exactly these, in any order.
        progress: called with a line of text for what was recognised in a table.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: an unknown kind of file, wrong touches, or a wrong value; names the file.
    """
    path = Path(path)
    miss_by_name = _read_csv(path, progress) if path.suffix == ".csv" else _read_yaml(path)
    if set(miss_by_name) != set(names):
        unmatched = ", ".join(sorted(set(miss_by_name) ^ set(names)))
        raise ValueError(
            f"{path}: expected the touches {', '.join(names)}; missing or unknown: {unmatched}"
        )
    if len({len(row) for row in miss_by_name.values()}) > 1:
        raise ValueError(f"{path}: some touches have z and some have none")
    misses = np.array([miss_by_name[name] for name in names])
    for name, row in zip(names, misses, strict=True):
        # A miss of 10 cm is no error of a calibration.
        if (np.abs(row) > MAX_MISS).any():
            raise ValueError(
                f"{path}: {name}: a miss of {np.abs(row).max():.4g} m, more than {MAX_MISS} m: "
                "millimetres given as metres, or positions instead of differences?"
            )
    return misses


def _read_csv(path: Path, progress: Callable[[str], None] | None) -> dict[str, np.ndarray]:
    """Return the misses of a table, m, by name; the header states the unit."""
    table = read_table(path, ("view",))
    if progress is not None:
        for note in table.notes:
            progress(note)
    rows = table.rows
    _ = table.view_ids()
    header = rows[0] if rows else {}
    for unit in LENGTH_UNITS:
        columns = [f"{axis}_{unit}" for axis in "xyz" if f"{axis}_{unit}" in header]
        if columns[:2] == [f"x_{unit}", f"y_{unit}"]:
            return {
                row["view"]: LENGTH_UNITS[unit] * parse_numbers(path, row, columns, row["view"])
                for row in rows
            }
    raise ValueError(f"{path}: expected the columns view, x_mm, y_mm, and z_mm if it was measured")


def _read_yaml(path: Path) -> dict[str, np.ndarray]:
    """Return the misses of a YAML file, m, by name."""
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(f"{path}: expected a file ending in .csv, .yaml or .yml")
    content = schemas.read_validated(path, schemas.MISSES_SCHEMA)
    return {
        name: LENGTH_UNITS[content.unit] * np.array(row) for name, row in content.misses.items()
    }
