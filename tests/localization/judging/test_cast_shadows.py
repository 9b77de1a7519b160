"""A shadow on the table looks like the top of a box that is sunk into it."""

import numpy as np
import pytest
from drawn_edges import drawn
from placed_box import MODEL, POSE
from seen_scene import SAMPLES

from smartview_jax.localization import EdgeLookup, Wireframe, judge
from smartview_jax.localization.edges.edge_lines import EXPLAINED_DISTANCE
from smartview_jax.localization.judging.candidates import Prepared
from smartview_jax.localization.judging.cast_shadows import log_odds_to_shadow
from smartview_jax.localization.judging.evidence import evidence_of
from smartview_jax.localization.refining.refinement import measured_lines

HEIGHT = float(np.ptp(MODEL.vertices[:, 2]))
TOP = set(np.flatnonzero(MODEL.vertices[:, 2] > MODEL.vertices[:, 2].mean()).tolist())
BELOW = [k for k, pair in enumerate(MODEL.edges.tolist()) if not set(pair) <= TOP]


@pytest.fixture(scope="module")
def entry(wireframe):
    return Prepared(MODEL, wireframe, Wireframe.of(MODEL, SAMPLES))


def standing(sideways, up, turn=0.0):
    """A box moved from `POSE` sideways and up, in its frame, m, and turned."""
    other = np.eye(4)
    other[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    other[:3, 3] = [*sideways, up]
    return POSE @ other


def lines_of(entry, views, hidden=()):
    pictures = drawn(MODEL, views, POSE, hidden=hidden)
    lookup = EdgeLookup.of(pictures, views.largest_picture)
    return measured_lines(entry.fine, views, lookup, POSE, EXPLAINED_DISTANCE)


def test_a_pose_with_nothing_but_the_edges_of_a_shadow_is_rejected(entry, views):
    lines = lines_of(entry, views, BELOW)
    other = standing([0.03, -0.02], HEIGHT)
    odds = log_odds_to_shadow(lines, entry, views, POSE, [other])
    # Of each missing piece of 12 px: it is missed with 0.1 where an edge is, and 0.8 in clutter.
    is_below = np.isin(np.asarray(entry.fine.sample_edges), BELOW)
    missing = lines.sample_px[:, is_below].sum()
    assert missing > 100.0
    np.testing.assert_allclose(odds, missing / 12.0 * np.log(0.1 / 0.8), rtol=0.08)


def test_the_odds_decide_what_the_other_edges_leave_open(entry, views):
    evidence = evidence_of(lines_of(entry, views), entry.fine, is_alone=False)
    assert judge(evidence, 24, np.inf).decision == "accepted"
    verdict = judge(evidence._replace(shadow_odds=-10.0), 24, np.inf)
    assert verdict.decision == "rejected"
    assert "shadow of an equal object" in verdict.reasons[0]
    unsure = judge(evidence._replace(shadow_odds=1.0), 24, np.inf)
    assert unsure.decision == "open"
    assert any("it may be the shadow" in reason for reason in unsure.reasons)


def test_a_box_under_another_has_edges_that_its_shadow_has_not(entry, views):
    lines = lines_of(entry, views)
    assert log_odds_to_shadow(lines, entry, views, POSE, [standing([0.03, -0.02], HEIGHT)]) > 30.0


@pytest.mark.parametrize(
    "other",
    [standing([0.03, -0.02], 0.5 * HEIGHT), standing([0.03, -0.02], HEIGHT, 0.5)],
)
def test_a_box_is_no_shadow_of_one_that_is_lower_or_turned(entry, views, other):
    lines = lines_of(entry, views)
    assert log_odds_to_shadow(lines, entry, views, POSE, [other]) is None
