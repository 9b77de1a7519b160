"""Say why touches miss by more than a calibration, a tip and a measurement can: what was wrong.

A single touch on another point contradicts the others, which agree without it. A tip, a base frame
or a target that is elsewhere moves all touches alike.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..evaluation import MAX_MISS
from ..geometry import vector_text
from .stylus_touches import compare_misses

SURPRISING_P_VALUE = 0.01
"""P-value below which misses are larger than expected."""

WRONG_UNIT = "millimetres given as metres, or positions instead of differences?"

LIKELY_CAUSES = (
    "the tip's position in the tool frame, the target's size, or a target that was moved"
)


def causes_of_misses(
    factor: Float[np.ndarray, "touches 3 errors"],
    misses: Float[np.ndarray, "touches d"],
    names: Sequence[str] | None = None,
) -> str:
    """Return what may have made misses larger than expected, as a clause.

    Args:
        factor: of the errors that are expected, as `measured_error_factor` returns it.
        misses: as `compare_misses` takes them.
        names: names of the touches; by default numbers from 1.
    """
    if np.abs(misses).max() > MAX_MISS:
        return WRONG_UNIT
    count = len(misses)
    names = names or [str(k + 1) for k in range(count)]
    every = np.arange(count)
    # Without one of two touches there is nothing to contradict the other.
    rests = [every != left_out for left_out in every] if count > 2 else []
    agreeing = [k for k, rest in enumerate(rests) if _is_expected(factor[rest], misses[rest])]
    if len(agreeing) == 1:
        return f"touch {names[agreeing[0]]} contradicts the others: it was on another point"
    # A displacement that all have in common, far larger than any that is looked for.
    common = np.broadcast_to(MAX_MISS * np.eye(3), (count, 3, 3))
    if count > 1 and _is_expected(np.concatenate([factor, common], axis=2), misses):
        shift = vector_text(1e3 * misses.mean(axis=0), 2)
        return (
            f"all touches miss alike, by about {shift} mm in the world's axes: another base or "
            "tool frame, the tip's position, or a target that was moved"
        )
    return LIKELY_CAUSES


def _is_expected(
    factor: Float[np.ndarray, "touches 3 errors"], misses: Float[np.ndarray, "touches d"]
) -> bool:
    """Return whether misses are as large as expected."""
    return compare_misses(factor, misses).p_value >= SURPRISING_P_VALUE
