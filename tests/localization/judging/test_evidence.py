"""How unlikely it is that edges of clutter fit a model exactly."""

import numpy as np
import pytest
from scipy.stats import binom

from smartview_jax.localization import VerdictOptions
from smartview_jax.localization.edges.edge_lines import EXPLAINED_DISTANCE, INDEPENDENT_LENGTH
from smartview_jax.localization.judging.evidence import (
    log_chance_of_exact_edges,
    log_chance_of_exactness,
    log_likelihood_of,
    log_likelihood_of_found,
)


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


def test_numbers_that_the_calibration_absorbs_are_no_evidence():
    assert log_chance_of_exactness(0.3, 10, 4.0) == log_chance_of_exactness(0.3, 8)


def test_one_wrong_edge_leaves_the_others_exact():
    exact = np.full(11, 0.05)
    alone = log_chance_of_exact_edges(exact)
    with_wrong = log_chance_of_exact_edges(np.append(exact, 0.9))
    # Any of twelve might have been the wrong one.
    assert alone < with_wrong < alone + np.log10(12.0) + 0.1
    assert with_wrong < log_chance_of_exactness(np.sqrt((11 * 0.05**2 + 0.9**2) / 12), 12) - 4.0


def test_sets_of_edges_that_fit_by_chance_are_as_rare_as_said():
    """Edges anywhere within the distance: no more than one in ten has a set of one in ten."""
    rng = np.random.default_rng(5)
    numbers = rng.uniform(-EXPLAINED_DISTANCE, EXPLAINED_DISTANCE, (4000, 9, 2))
    logs = [log_chance_of_exact_edges(np.linalg.norm(edges, axis=1)) for edges in numbers]
    assert (np.array(logs) < -1.0).mean() < 0.1


def test_pieces_of_edges_are_found_with_the_probabilities_that_are_given():
    """Eight of ten pieces, and what the two that are missing say."""
    options = VerdictOptions(found_probability=0.7, chance_probability=0.1)
    ratio = binom.logpmf(8, 10, 0.7) - binom.logpmf(8, 10, 0.1)
    px = 10.0 * INDEPENDENT_LENGTH
    assert log_likelihood_of(0.8, px, options) == pytest.approx(ratio)
    found = log_likelihood_of_found(0.8 * px, options)
    assert found == pytest.approx(ratio - 2.0 * np.log(0.3 / 0.9))
