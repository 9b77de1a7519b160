"""Find states of the robot in which the pictures of two cameras were exchanged.

Two cameras on one hand, or two next to the arm, that see one target have one relative pose K in all
states, which follows from their pictures alone. In a state whose pictures were exchanged it is
K^-1. Each camera by itself then seems to have been moved to another place and back.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import betaln

from ..argument_checks import MAX_LISTED_VIEWS, listed
from ..dataset import Rig, evenly_spaced
from ..geometry import host_logarithms, mean_matrix
from .closure import Poses
from .rig_states import (
    MAX_CHANCE,
    MAX_LEFT_OVER,
    MIN_COMMON_STATES,
    SeenTarget,
    pairs_with_one_target,
    states_in_common,
)
from .transform_fit import misfit_text, misfits

MAX_SEEDS = 20
"""Largest number of states whose relative pose is tried as the one of all states."""


class _Exchange(NamedTuple):
    """States in which two cameras' pictures seem to be exchanged.

    Attributes:
        exchanged: mask of these states among those that both cameras saw.
        given, corrected: relative poses of the cameras, divided by their mean, in each state.
    """

    exchanged: Bool[np.ndarray, "states"]
    given: Poses
    corrected: Poses


def exchanged_cameras(rig: Rig, seen: Mapping[str, SeenTarget]) -> tuple[str, ...]:
    """Return a sentence for each pair of cameras whose pictures are exchanged in some states.

    Args:
        rig: data sets of the cameras.
        seen: the target as each camera sees it; cameras that are not listed are not compared.
    """
    sentences = []
    for first, second in pairs_with_one_target(rig, seen):
        states, *poses = states_in_common(rig, first, second, seen)
        exchange = _exchange(poses[1] @ np.linalg.inv(poses[0]))
        if exchange is None:
            continue
        names = [rig.view_ids[state] for state in states[exchange.exchanged]]
        given, corrected = (
            misfit_text(misfits(closure).mean(axis=0))
            for closure in (exchange.given, exchange.corrected)
        )
        sentences.append(
            f"the pictures of cameras {first!r} and {second!r} are exchanged in {len(names)} of "
            f"{len(states)} states ({listed(names, MAX_LISTED_VIEWS)}), or in the "
            f"others: the relative pose of the cameras then varies by {corrected} instead of "
            f"{given} (means over the states). Exchange them there"
        )
    return tuple(sentences)


def _exchange(relative: Poses) -> _Exchange | None:
    """Return in which states the cameras are exchanged; None if in none.

    Args:
        relative: pose of one camera in the other in each state.
    """
    count = len(relative)
    if count < MIN_COMMON_STATES:
        return None
    both = np.stack([relative, np.linalg.inv(relative)])
    seeds = relative[evenly_spaced(count, MAX_SEEDS)]
    squares = np.stack([_squares(np.linalg.inv(seed) @ both) for seed in seeds])
    best = np.median(squares.min(axis=1), axis=1).argmin()
    exchanged = squares[best].argmin(axis=0) == 1
    if exchanged.sum() > count / 2:
        exchanged = ~exchanged
    if not exchanged.any():
        return None
    corrected = np.where(exchanged[:, None, None], both[1], both[0])
    given, corrected = (_about_mean(poses) for poses in (relative, corrected))
    # In units in which rotation and translation of the corrected poses scatter alike.
    twists = host_logarithms(corrected)
    parts = np.sqrt((twists**2).reshape(-1, 2, 3).mean(axis=(0, 2)))
    scale = np.repeat(np.maximum(parts, 1e-9), 3)
    before, after = _squares(given, scale), np.sum((twists / scale) ** 2, axis=-1)
    is_explained = (after <= MAX_LEFT_OVER * before)[exchanged].all()
    # Exact poses leave nothing over, and do not tell cameras at one place apart.
    left_over = max(after.sum(), 1e-9)
    if not is_explained or left_over > MAX_LEFT_OVER * before.sum():
        return None
    freedom = _dimensions(twists / scale) * (count - 1)
    log_chance = _log_chance(before.sum() / left_over, freedom)
    # Each state may be exchanged or not: two to the number of states chances.
    if log_chance + count * np.log(2.0) > np.log(MAX_CHANCE):
        return None
    return _Exchange(exchanged, given, corrected)


def _dimensions(twists: Float[np.ndarray, "states 6"]) -> float:
    """Return in how many directions twists scatter: 6 if alike in all, 1 if along one line.

    Cameras at one place whose errors lie along one line, as of a flat target's tilt, agree better
    with about half of the states exchanged, by chance. This is Satterthwaite's number.
    """
    moments = twists.T @ twists
    return max(float(np.trace(moments) ** 2 / max((moments**2).sum(), 1e-300)), 1.0)


def _log_chance(ratio: float, freedom: float) -> float:
    """Return the logarithm of the probability that equal variances have a larger ratio by chance.

    Fisher's distribution gives I_y(a, a) with a = freedom / 2 and y = 1 / (1 + ratio). Its series
    is bounded by the geometric series of 2 y. So the result is a little too large, but finite.

    Args:
        ratio: of two estimated variances, above 1.
        freedom: degrees of freedom of each.
    """
    a, y = freedom / 2.0, 1.0 / (1.0 + ratio)
    return float(a * np.log(y * (1.0 - y)) - np.log(a) - betaln(a, a) - np.log1p(-2.0 * y))


def _about_mean(poses: Poses) -> Poses:
    """Return poses in the axes of their mean."""
    return np.linalg.inv(mean_matrix(poses, np.ones(len(poses)))) @ poses


def _squares(
    poses: Float[np.ndarray, "*states 4 4"], scale: Float[np.ndarray, "6"] | float = 1.0
) -> Float[np.ndarray, "*states"]:
    """Return the sum of squares of each pose's twist, in some scale."""
    return np.sum((host_logarithms(poses) / scale) ** 2, axis=-1)
