"""The order in which poses are judged, and which of them are not worth a refinement."""

from types import SimpleNamespace

import numpy as np
from drawn_edges import TWO_DIRECTIONS, drawn, evidence, seen_views

from smartview_jax import simulation
from smartview_jax.localization import Localization, judging
from smartview_jax.localization.candidates import Candidate, Prepared, Query
from smartview_jax.localization.scene import Scene
from smartview_jax.localization.verdict import DEFAULT_OPTIONS, VerdictOptions
from smartview_jax.modeling import CalibrationUncertainty


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
    return Candidate(0, np.eye(4), visible_px, share * visible_px)


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
    assert judgement.left == [good] * 3


def test_a_pose_is_left_out_by_no_fewer_samples_than_the_verdict_has():
    """Ten edges of a small block show, 17 to 68 px long; with few samples seven have lines."""
    model = simulation.roofed_block(0.03).exact_model("roofed")
    views = seen_views(model.vertices.mean(axis=0), TWO_DIRECTIONS[:1], 0.6)
    scene = Scene(views, evidence(drawn(model, views, np.eye(4), 0.05)), np.zeros((0, 3, 3)))
    for needed, is_rejected in ((10, False), (11, True)):
        options = VerdictOptions(min_edges=needed)
        query = Query([Prepared.of(model)], CalibrationUncertainty.none(views), options)
        judge = judging._Judging(scene, query, 1)
        assert judge.is_rejected_unrefined(candidate(1.0, 500.0)) == is_rejected
