"""Define what the tool does between the poses of a grasp: straight motions, opening, closing.

In VAL, MOVES is a straight line and MOVE a joint-interpolated motion. OPENI and CLOSEI wait until
the arm stands, then move the fingers; OPEN and CLOSE move them on the way to the next location.
BREAK waits as well: without it the controller blends into the next motion, so that a straight line
would not begin where it was checked.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np


class HandSteps(NamedTuple):
    """The actions of the tool on its way to each pose of a grasp; one entry for each pose.

    Attributes:
        straight: whether the tool moves in a straight line; otherwise by joint interpolation.
        opening: distance between the fingers, m, set before the motion; zero closes them on the
            object.
    """

    straight: tuple[bool, ...]
    opening: tuple[float, ...]

    @property
    def motions(self) -> tuple[str, ...]:
        """The column `motion` of CSV and JSON: "straight" or "free"."""
        return tuple("straight" if straight else "free" for straight in self.straight)


def hand_columns(hand: HandSteps | None, count: int) -> list[tuple[str, float] | tuple[()]]:
    """Return the columns `motion` and `opening_m` of each pose; no columns without a hand.

    Raises:
        ValueError: a wrong number of steps, or an opening that is negative or not finite.
    """
    if hand is None:
        return [()] * count
    _check_hand(hand, count)
    return list(zip(hand.motions, map(float, hand.opening), strict=True))


def val_hand(hand: HandSteps, count: int) -> list[list[str]]:
    """Return the lines of VAL before the motion to each pose.

    Raises:
        ValueError: as in `hand_columns`.
    """
    _check_hand(hand, count)
    lines = []
    openings, motions = (np.nan, *hand.opening), (True, *hand.straight)
    for (old, new), (was_straight, straight) in zip(
        pairwise(openings), pairwise(motions), strict=True
    ):
        actions = ["BREAK"] if straight and not was_straight else []
        if new != old:
            actions.append(f"OPENI {1e3 * new:.2f}" if new > 0.0 else "CLOSEI")
        lines.append(actions)
    return lines


def _check_hand(hand: HandSteps, count: int) -> None:
    """Raise a ValueError for a wrong number of steps or an impossible opening."""
    if not len(hand.straight) == len(hand.opening) == count:
        raise ValueError(
            f"hand: expected an entry for each of {count} poses, found {len(hand.straight)} in "
            f"straight and {len(hand.opening)} in opening"
        )
    for opening in hand.opening:
        if not 0.0 <= opening < np.inf:
            raise ValueError(f"hand: opening: expected metres, 0 or more, found {opening!r}")
