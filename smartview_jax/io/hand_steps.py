"""Say what a tool does between the poses of a grasp: straight lines, and opening and closing.

In VAL a straight line is MOVES, where MOVE lets each joint turn as it likes. OPENI and CLOSEI wait
until the arm stands, then move the fingers; OPEN and CLOSE move them on the way to the next
location. BREAK waits as well: without it the controller rounds the corner to the next motion, so
that a straight line would not begin where it was checked.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np


class HandSteps(NamedTuple):
    """The actions of the tool on its way to each pose of a grasp; one entry for each pose.

    Attributes:
        straight: whether it moves there in a straight line; otherwise as the robot likes.
        opening: distance between the fingers, m, to which they are set before it sets out; zero
            closes them on what is between them.
    """

    straight: tuple[bool, ...]
    opening: tuple[float, ...]

    @property
    def motions(self) -> tuple[str, ...]:
        """The column `motion` of CSV and JSON: "straight" or "free"."""
        return tuple("straight" if straight else "free" for straight in self.straight)


def hand_columns(hand: HandSteps | None, count: int) -> list[tuple[str, float] | tuple[()]]:
    """Return the columns `motion` and `opening_m` of each pose; without a hand there are none.

    Raises:
        ValueError: the hand has another number of steps, or an opening that cannot be.
    """
    if hand is None:
        return [()] * count
    _check_hand(hand, count)
    return list(zip(hand.motions, map(float, hand.opening), strict=True))


def val_hand(hand: HandSteps, count: int) -> list[list[str]]:
    """Return the lines of VAL before the motion to each of so many poses.

    Raises:
        ValueError: as in `hand_columns`.
    """
    _check_hand(hand, count)
    lines = []
    # Neither opening nor motion is known before the first pose.
    openings, motions = (np.nan, *hand.opening), (True, *hand.straight)
    for (old, new), (was_straight, straight) in zip(
        pairwise(openings), pairwise(motions), strict=True
    ):
        own = ["BREAK"] if straight and not was_straight else []
        if new != old:
            own.append(f"OPENI {1e3 * new:.2f}" if new > 0.0 else "CLOSEI")
        lines.append(own)
    return lines


def _check_hand(hand: HandSteps, count: int) -> None:
    """Raise a ValueError if the steps of a hand are not those of so many poses."""
    if not len(hand.straight) == len(hand.opening) == count:
        raise ValueError(
            f"hand: expected an entry for each of {count} poses, found {len(hand.straight)} in "
            f"straight and {len(hand.opening)} in opening"
        )
    for opening in hand.opening:
        if not 0.0 <= opening < np.inf:
            raise ValueError(f"hand: opening: expected metres, 0 or more, found {opening!r}")
