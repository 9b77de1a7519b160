"""Join the pictures of a camera on one hand with the poses of the arm that carries the target."""

import dataclasses
from pathlib import Path

from ..argument_checks import errors_at
from ..dataset import Dataset
from ..geometry import host_matrices
from ..targets import AbstractTarget
from .poses import RobotReadings


def with_other_hand(data: Dataset, other: RobotReadings, table: Path) -> Dataset:
    """Return the data of a camera on a hand, with the poses of the arm that carries the target.

    The other arm may have reported its pose in further views, too.
    """
    place = {view: k for k, view in enumerate(other.view_ids)}
    if missing := [view for view in data.view_ids if view not in place]:
        raise ValueError(f"{table}: no pose for the view {', '.join(missing[:5])}")
    index = [place[view] for view in data.view_ids]
    wrong = [k for k, view in enumerate(data.view_ids) if view in other.masked_views]
    masked = [(data.view_ids[k], other.masked_views[data.view_ids[k]]) for k in wrong]
    known = {view for view, _ in data.masked_views}
    new = tuple(entry for entry in masked if entry[0] not in known)
    data = dataclasses.replace(data.mask_views(wrong), masked_views=(*data.masked_views, *new))
    with errors_at(table):
        return data.between_hands(host_matrices(other.poses)[index])


def require_one_numbering(target: AbstractTarget, path: Path) -> None:
    """Raise a ValueError for a target whose points have several numberings.

    The motion of one arm tells which numberings agree; the motions of two do not, as long as it is
    not known where their bases are.
    """
    board = target.flat_board
    if len(board.symmetries) > 1:
        raise ValueError(
            f"{path}: target: a target on another hand must not look the same when turned, as this "
            f"{type(board).__name__} does: take a ChArUco board or an AprilGrid, or a chessboard "
            "with an odd and an even number of squares"
        )
