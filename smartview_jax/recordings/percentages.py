"""Recognise joint readings that LeRobot recorded in percent of each joint's range of motion.

The description of a data set does not tell the unit, but the readings do. An encoder counts in
whole steps. With N = range_max - range_min steps between the two ends of a joint's motion, known
from the arm's calibration, LeRobot records for the step number k

    in percent    -100 + 200 k / N,                    with another N in each joint
    in degrees    (k - N / 2) 360 / (resolution - 1),  with the same step in all joints

Reference: MotorsBus._normalize in https://github.com/huggingface/lerobot (motors/motors_bus.py).
"""

import numpy as np
from jaxtyping import Float

MAX_STEPS = 4095
"""Largest number of steps between the ends of a joint's motion: the encoders have 12 bits."""

MIN_STEPS = 100
"""Smallest number of steps that is looked for: a joint that moves by 9 degrees."""

STEP_TOLERANCE = 2e-4
"""Largest distance from a whole step: readings in float32 are rounded by 0.8e-4 of a step."""

MIN_READINGS = 4
"""Smallest number of different readings that tell: by chance so many fit some N in 1e-10 cases."""

MAX_READINGS = 200
"""Largest number of different readings that are looked at, evenly spread."""

DECIMALS = 3
"""Readings with so few decimals were rounded: their steps are of the decimals."""


def refuse_percentages(where: str, readings: Float[np.ndarray, "frames joints"]) -> None:
    """Refuse joint readings that are in percent of each joint's range of motion.

    Args:
        where: the file and the feature, for the message.
        readings: of the joints that turn, as recorded.

    Raises:
        ValueError: two or more joints have the steps of percentages.
    """
    counts = [_steps_of_range(column) for column in readings.T]
    if len({count for count in counts if count}) < 2:
        return
    listed = ", ".join("?" if count is None else str(count) for count in counts)
    raise ValueError(
        f"{where}: expected joint readings in degrees or radians, found percent of each joint's "
        f"range of motion: they are whole steps of 200 / N from -100 on, with N = {listed}. Record "
        "with LeRobot's use_degrees=true, or convert with the arm's calibration file of LeRobot: "
        f"degrees = percent / 200 * (range_max - range_min) * 360 / {MAX_STEPS}"
    )


def _steps_of_range(readings: Float[np.ndarray, "frames"]) -> int | None:
    """Return the smallest N for which all readings are -100 + 200 k / N; None if there is none."""
    values = np.unique(readings)
    if len(values) < MIN_READINGS or np.abs(values).max() > 100.0 + STEP_TOLERANCE:
        return None
    if np.allclose(values, values.round(DECIMALS), rtol=0.0, atol=1e-5):
        return None
    values = values[np.linspace(0, len(values) - 1, min(len(values), MAX_READINGS)).astype(int)]
    counts = np.arange(MIN_STEPS, MAX_STEPS + 1)
    steps = (values + 100.0) * (counts[:, None] / 200.0)
    fitting = counts[np.all(np.abs(steps - steps.round()) < STEP_TOLERANCE, axis=1)]
    return int(fitting[0]) if len(fitting) else None
