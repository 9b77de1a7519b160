"""The order in which poses are judged, without pictures."""

from types import SimpleNamespace

import numpy as np

from smartview_jax.localization import Localization
from smartview_jax.localization.judging import judging
from smartview_jax.localization.judging.candidates import Candidate, Query
from smartview_jax.localization.judging.options import DEFAULT_OPTIONS


class Recorded(judging._Judging):
    """Verdicts that reject everything, and a list of the poses that were judged."""

    def __init__(self):
        super().__init__(None, Query([], None, DEFAULT_OPTIONS), 0)
        self.asked = []

    def is_rejected_unrefined(self, candidate):
        return False

    def best_explanation(self, first, others):
        self.asked.append(first)
        return Localization(None, first.model, None, SimpleNamespace(decision="rejected"), ())


def candidate(share, visible_px):
    return Candidate(0, np.eye(4), visible_px, share * visible_px, 0.0)


def test_a_short_pose_that_explains_little_does_not_end_the_search():
    # The shortest one comes before the longest by its likelihood, which counts what is missing.
    given = [candidate(0.9, 1000.0), candidate(0.38, 100.0), candidate(0.55, 2500.0)]
    assert given == sorted(given, key=lambda one: -one.log_likelihood)
    recorded = Recorded()
    recorded.in_order(given, [])
    assert recorded.asked == [given[0], given[2]]


def test_what_is_skipped_leaves_the_others_their_places():
    good, poor = candidate(0.9, 1000.0), candidate(0.3, 10.0)
    recorded = Recorded()
    most = judging.MAX_REJECTED
    judgement = recorded.in_order([good, *[poor] * most, *[good] * (most + 2)], [])
    assert recorded.asked == [good] * most
    # The others are not forgotten without a word.
    assert judgement.unjudged == [good] * 3
