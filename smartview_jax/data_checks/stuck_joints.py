"""Find joints whose readings stay the same in successive views while most joints move.

A driver that stops to publish one joint repeats its last value to the last digit. A joint that
really stands still has such readings as well, so this is asked only where robot and camera do not
move alike. Whoever jogs an arm moves few joints at a time: only views between which most of the
joints moved count.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

MIN_STUCK_VIEWS = 4
"""Fewest successive views with the same reading of a joint that is named."""


def stuck_joints(
    readings: Float[np.ndarray, "views joints"],
    used: Bool[np.ndarray, "views"],
    view_ids: Sequence[str],
) -> str:
    """Return which joints have one reading in many successive views, as a sentence; or nothing.

    Args:
        readings: joint readings, in the order in which the views were taken.
        used: mask of the views to use.
        view_ids: names of the views.
    """
    views = np.flatnonzero(used)
    if len(views) < MIN_STUCK_VIEWS:
        return ""
    is_same = np.diff(readings[views], axis=0) == 0.0
    # Between two pictures from one pose no joint moved.
    moves = np.flatnonzero(~is_same.all(axis=1))
    is_same &= 2 * is_same.sum(axis=1, keepdims=True) < readings.shape[1]
    texts = []
    for joint in range(readings.shape[1]):
        first, count = _longest_run(is_same[moves, joint])
        if count + 1 < MIN_STUCK_VIEWS:
            continue
        begin, end = (view_ids[int(views[k])] for k in (moves[first], moves[first + count - 1] + 1))
        texts.append(f"joint {joint + 1} from view {begin} to {end}")
    if not texts:
        return ""
    return (
        f"a reading stays the same to the last digit while most joints move: {', '.join(texts)}: "
        "was it read again for each view?"
    )


def _longest_run(flags: Bool[np.ndarray, "moves"]) -> tuple[int, int]:
    """Return where the longest run of true flags begins, and how long it is."""
    edges = np.diff(np.concatenate([[0], flags.astype(int), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    if not len(begins):
        return 0, 0
    longest = int(np.argmax(ends - begins))
    return int(begins[longest]), int(ends[longest] - begins[longest])
