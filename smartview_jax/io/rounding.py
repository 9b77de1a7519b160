"""Say when a table of poses has so few digits that rounding exceeds the robot's own errors."""

import numpy as np
from jaxtyping import Float

from ..geometry import ANGLE_UNITS, LENGTH_UNITS
from .pose_format import PoseFormat

MAX_POSITION_STD, MAX_ANGLE_STD = 1e-4, float(np.deg2rad(0.02))
"""Standard deviations of rounding, m and rad, from which it is said: an arm repeats within 0.01 to
0.1 mm, which a hand of half a metre turns into as many hundredths of a degree."""

MIN_NUMBERS = 12
"""Fewest numbers, zeros not counted, from which it is told how they were rounded."""

_EXPONENTS = range(3, -9, -1)
"""Exponents of the steps that are tried, the coarsest first."""


def rounding_note(name: str, rows: Float[np.ndarray, "views numbers"], form: PoseFormat) -> str:
    """Return a sentence on rounded poses; empty if their digits are enough.

    Rounding to steps of s makes errors of s / sqrt(12), standard deviation.
    """
    lengths = list(form.codec.length_columns)
    others = np.setdiff1d(np.arange(rows.shape[1]), lengths)
    parts = []
    step = _step(rows[:, lengths]) * LENGTH_UNITS[form.length_unit]
    if step / np.sqrt(12.0) > MAX_POSITION_STD:
        parts.append(f"positions to {1e3 * step:g} mm")
    # An error e of a quaternion's imaginary part turns by 2 e, one of a matrix's entry by e.
    unit = 2.0 if len(others) == 4 else 1.0
    if form.codec.angle_columns:
        unit = ANGLE_UNITS[form.angle_unit]
    step = _step(rows[:, others]) * unit
    if step / np.sqrt(12.0) > MAX_ANGLE_STD:
        parts.append(f"rotations to {np.rad2deg(step):.2g} degrees")
    if not parts:
        return ""
    return (
        f"{name} has {' and '.join(parts)}: if they were rounded, this alone makes errors of 0.3 "
        "of that, more than a good arm's; export more digits"
    )


def _step(numbers: Float[np.ndarray, "views numbers"]) -> float:
    """Return the largest power of ten that divides all numbers; 0 if there are too few of them."""
    values = numbers[np.isfinite(numbers) & (np.abs(numbers) > 1e-12)]
    # Ones of a matrix, and a coordinate that never changes, tell nothing.
    if len(np.unique(np.abs(values))) < MIN_NUMBERS:
        return 0.0
    for exponent in _EXPONENTS:
        multiples = values / 10.0**exponent
        if np.abs(multiples - np.round(multiples)).max() < 1e-6:
            return 10.0**exponent
    return 0.0
