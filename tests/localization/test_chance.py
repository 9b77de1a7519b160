"""How unlikely it is that edges of clutter explain a model, or fit it exactly."""

import numpy as np
import pytest

from smartview_jax.localization.chance import log_chance_of_exactness
from smartview_jax.localization.edge_lines import EXPLAINED_DISTANCE


@pytest.mark.parametrize(("edges", "rms"), [(4, 0.6), (5, 1.4)])
def test_the_chance_is_that_of_numbers_anywhere_within_the_distance(edges, rms):
    """Two numbers of each edge, less the six that the pose takes up."""
    rng = np.random.default_rng(4)
    numbers = rng.uniform(-EXPLAINED_DISTANCE, EXPLAINED_DISTANCE, (400_000, 2 * edges - 6))
    # The RMS distance of an edge has both of its numbers.
    share = (np.sqrt(2.0 * (numbers**2).mean(axis=1)) <= rms).mean()
    assert 10.0 ** log_chance_of_exactness(rms, edges) == pytest.approx(share, rel=0.05)


def test_few_edges_say_nothing_and_inexact_ones_no_more_than_that():
    assert log_chance_of_exactness(0.05, 3) == 0.0
    assert log_chance_of_exactness(10.0, 12) == 0.0
    assert log_chance_of_exactness(0.05, 14) < -15.0
