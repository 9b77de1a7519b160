"""Read the board's height in each picture, for data where every picture has its own robot pose.

If the board is raised under a robot that does not move, a view has a picture for each height. If
the robot instead goes through all its poses, the board is raised, and the robot repeats the poses
(not exactly), every picture has its own row in the table of poses or joint readings, and the
column `height` holds the index of the board's height:

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
        table: the table of poses, joint readings or picture times; None if the poses are in a file
            of another format, which has no further columns.
        target: only a `StackedTarget` has several heights.
        view_ids: ids of all views in the table.
        suffix: suffix of the names in the table that the ids do not have.

    Raises:
        ValueError: a row whose height is not an index of the target's heights; names file and
            view.
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
