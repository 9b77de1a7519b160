"""Joint readings in percent of a joint's range are told from angles by their steps."""

import numpy as np
import pytest

from smartview_jax.recordings.import_lerobot import refuse_percentages

ENDS = np.array([[754, 3230], [871, 3271], [862, 3054], [829, 3169], [0, 4095]])
"""Range of motion of five joints of an SO-101, steps of the encoder."""


def step_numbers(seed=0, frames=300):
    low, high = ENDS.T
    return np.random.default_rng(seed).integers(low, high + 1, (frames, len(ENDS)))


def in_percent(steps):
    """The formula of LeRobot's `MotorsBus._normalize`, stored as its tables do."""
    low, high = ENDS.T
    return ((steps - low) / (high - low) * 200.0 - 100.0).astype(np.float32).astype(float)


def in_degrees(steps):
    return ((steps - ENDS.mean(axis=1)) * 360.0 / 4095.0).astype(np.float32).astype(float)


@pytest.mark.parametrize("frames", [6, 300])
def test_percentages_are_refused(frames):
    with pytest.raises(ValueError, match=r"set: state: .* percent of .* N = 2476, 2400, 2192, 23"):
        refuse_percentages("set: state", in_percent(step_numbers(frames=frames)))


@pytest.mark.parametrize("seed", range(6))
def test_angles_are_not_refused(seed):
    """Of the encoder, within 100 degrees too; rounded; of a simulation; of an arm that stands."""
    near = np.clip(step_numbers(seed), 1700, 2400)
    waves = 80.0 * np.sin(np.linspace(0.0, 6.0, 300)[:, None] * np.arange(1.0, 6.0) + seed)
    ramps = np.linspace(-30.0, 30.0, 301)[:, None] * np.array([0.37, 1.0, 1.7, 2.0, 3.1])
    angles = [in_degrees(near), in_degrees(step_numbers(seed)), waves, ramps, np.zeros((300, 5))]
    angles += [waves.round(decimals) for decimals in range(4)]
    for readings in angles:
        refuse_percentages("set: state", readings)
        refuse_percentages("set: state", readings.astype(np.float32).astype(float))
