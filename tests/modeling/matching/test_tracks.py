import numpy as np
import pytest

from smartview_jax.modeling import direction_turn


def test_the_turn_is_the_mean_of_the_nearest_angles():
    first = np.array([0.1, np.pi - 0.05, np.nan])
    second = np.array([-np.pi + 0.05, 0.3, 1.5])
    assert direction_turn(first, second) == pytest.approx(0.5 * (0.2 + 0.1))
    assert np.isnan(direction_turn(first, np.full(3, np.nan)))
    assert direction_turn(first, first) == 0.0
