"""Match the names of views in several tables of one folder.

Some programs name a view by its picture's file, `0001.png`, and others by the file's name without
its suffix. Where two tables differ by this only, the views are the same, and the user is told.
"""

from collections.abc import Sequence

from .csv_tables import Table
from .table_text import VIEW_COLUMN

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
"""Suffixes of files that are counted as pictures, in lower case."""


def without_picture_suffix(name: str) -> str:
    """Return a name without the suffix of a picture's file; the name itself where it has none."""
    stem, point, suffix = name.rpartition(".")
    return stem if stem and f"{point}{suffix}".lower() in PICTURE_SUFFIXES else name


def with_names_of(
    table: Table, view_ids: Sequence[str]
) -> tuple[list[dict[str, str]], tuple[str, ...]]:
    """Return a table's rows with the names that another table has, and a note if they differ.

    Args:
        table: with a column of views.
        view_ids: names of the other table. Names of this one that are not among them are changed
            if all of them differ from one of these by a picture's suffix only.
    """
    found = {row[VIEW_COLUMN] for row in table.rows}
    stems = {without_picture_suffix(view): view for view in view_ids}
    renamed = {view: stems.get(without_picture_suffix(view)) for view in found - set(view_ids)}
    names = {view: name for view, name in renamed.items() if name is not None}
    # Two names that become one, or two views that have one stem, are other names.
    unambiguous = (
        len(names) == len(renamed) > 0
        and len(stems) == len(view_ids)
        and len({*names.values(), *(found & set(view_ids))}) == len(found)
    )
    if not unambiguous:
        return table.rows, ()
    rows = [
        {**row, VIEW_COLUMN: names.get(row[VIEW_COLUMN], row[VIEW_COLUMN])} for row in table.rows
    ]
    old, new = min(names.items())
    return rows, (
        f"{table.path.name}: its views are those of the other table but for the pictures' suffix, "
        f"such as {old} and {new}",
    )
