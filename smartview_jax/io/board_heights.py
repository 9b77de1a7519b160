"""Read at which height the board stood in each picture, where every picture has its own robot pose.

A board may be raised under a robot that does not move: then a view has a picture for each height.
Or the robot goes through all its poses, the board is raised, and the robot goes through them again,
which it does not exactly: then every picture has a row of its own in the table of poses (or of
joint readings), and a column `height` with the index of the board's height in it:

    view,height,x,y,z,...
    first_0,0,...
    first_1,1,...
"""

from collections.abc import Sequence

from ..targets import AbstractTarget, StackedTarget
from .csv_tables import Table

HEIGHT_COLUMN = "height"
"""The name of the column with the index of the board's height."""


def read_board_heights(
    table: Table | None, target: AbstractTarget, view_ids: Sequence[str], suffix: str = ""
) -> dict[str, int] | None:
    """Return the index of the board's height by view; None if a view has a picture of each height.

    Args:
        table: of the poses, the joint readings or the pictures' times; None if the poses are in a
            file of another format, which has no further columns.
        target: only a `StackedTarget` has several heights.
        view_ids: ids of all views, which are the table's.
        suffix: with which the table's names end beyond those ids.

    Raises:
        ValueError: a row whose height is no index of the target's heights, with file and view.
    """
    if not isinstance(target, StackedTarget) or table is None:
        return None
    rows = {row["view"].removesuffix(suffix): row for row in table.rows}
    if HEIGHT_COLUMN not in next(iter(rows.values())):
        return None
    indices = [str(k) for k in range(len(target.heights))]
    for view in view_ids:
        if rows[view][HEIGHT_COLUMN] not in indices:
            raise ValueError(
                f"{table.path}: view {view}: {HEIGHT_COLUMN} is {rows[view][HEIGHT_COLUMN]!r}; "
                f"expected the index of one of the target's heights, 0 to {len(indices) - 1}"
            )
    return {view: int(rows[view][HEIGHT_COLUMN]) for view in view_ids}
