"""Tell pictures by their names, and match the names of views in several tables of one folder.

Some programs name a view by its picture file, `0001.png`, others by the file name without suffix.
If two tables differ only by this, or by leading zeros, which a spreadsheet removes, their views are
matched, and the user gets a note.
"""

from collections.abc import Sequence
from pathlib import Path

from .csv_tables import Table
from .table_text import VIEW_COLUMN

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
"""Suffixes of files that are counted as pictures, in lower case."""


def is_picture_name(path: Path) -> bool:
    """Return whether a file has the suffix of a picture and is not hidden."""
    return path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith(".")


def without_picture_suffix(name: str) -> str:
    """Return a name without the suffix of a picture file, if it has one."""
    stem, point, suffix = name.rpartition(".")
    return stem if stem and f"{point}{suffix}".lower() in PICTURE_SUFFIXES else name


def _common_name(name: str) -> str:
    """Return a name without a picture's suffix, and a number without leading zeros."""
    stem = without_picture_suffix(name)
    return stem.lstrip("0") or "0" if stem.isdecimal() else stem


def with_names_of(
    table: Table, view_ids: Sequence[str]
) -> tuple[list[dict[str, str]], tuple[str, ...]]:
    """Return a table's rows with view names as in another table, and a note if any was changed.

    Names are changed if each differs from one there only by a picture suffix or leading zeros.
    """
    table_views = {row[VIEW_COLUMN] for row in table.rows}
    stems = {_common_name(view): view for view in view_ids}
    renamed = {view: stems.get(_common_name(view)) for view in table_views - set(view_ids)}
    names = {view: name for view, name in renamed.items() if name is not None}
    # No change if two names would become equal, or if two views have the same stem.
    unambiguous = (
        len(names) == len(renamed) > 0
        and len(stems) == len(view_ids)
        and len({*names.values(), *(table_views & set(view_ids))}) == len(table_views)
    )
    if not unambiguous:
        return table.rows, ()
    rows = [
        {**row, VIEW_COLUMN: names.get(row[VIEW_COLUMN], row[VIEW_COLUMN])} for row in table.rows
    ]
    old, new = min(names.items())
    return rows, (
        f"{table.path.name}: view names differ from the other table by the picture suffix or "
        f"leading zeros and were matched, such as {old} and {new}",
    )
