import numpy as np
import pytest

from smartview_jax.localization import Evidence, VerdictOptions, judge
from smartview_jax.localization.judging.evidence import log_chance_of_exact_edges
from smartview_jax.localization.judging.moved_faces import MovedFace
from smartview_jax.localization.judging.verdict import DEFAULT_OPTIONS, may_be_another_size

CLEAR = Evidence(
    explained=0.95,
    explained_in_view=(0.95, 0.95),
    visible_px=2000.0,
    is_alone=False,
    edges=16,
    has_faces=True,
    edge_rms=0.1,
    in_picture=1.0,
    in_front=1.0,
    log_likelihood=300.0,
    log_exactness=0.0,
)


def verdict(margin=np.inf, uncertainty=0.0, **changes):
    evidence = CLEAR._replace(**changes)
    exactness = log_chance_of_exact_edges(np.full(evidence.edges, evidence.edge_rms))
    evidence = evidence._replace(log_exactness=exactness)
    return judge(evidence, 24, margin, uncertainty=uncertainty)


def test_clear_pose_is_accepted():
    assert verdict().decision == "accepted"
    assert not verdict().reasons


@pytest.mark.parametrize(
    ("changes", "decision", "words"),
    [
        ({"explained": 0.3}, "rejected", "only 30% of its visible edges"),
        ({"log_likelihood": -5.0}, "rejected", "clutter matches as well"),
        ({"edges": 4}, "rejected", "background clutter matches as well: 4 matched edges"),
        ({"log_likelihood": 1.0, "edge_rms": 1.7}, "rejected", "clutter matches as well"),
        ({"explained": 0.75, "edge_rms": 0.6}, "open", "and these fit to 0.60 px"),
        ({"log_likelihood": 1.0, "edges": 5, "edge_rms": 0.4}, "open", "little evidence"),
        ({"explained_in_view": (0.95, np.nan)}, "open", "only 1 of 2 views"),
        ({"explained_in_view": (0.95, 0.4)}, "open", "view 1: 40%"),
        ({"in_picture": 0.5}, "open", "only 50% of its vertices are within a picture"),
        ({"in_front": 0.2}, "open", "80% of its edges are occluded by other objects"),
        ({"edge_rms": 1.25, "edges": 60}, "open", "1.25 px (RMS)"),
        ({"uncertainty": 0.06}, "open", "uncertain by 6%"),
        ({"margin": 2.0}, "open", "ambiguous"),
    ],
)
def test_each_weakness_is_named(changes, decision, words):
    actual = verdict(**changes)
    assert actual.decision == decision
    assert any(words in reason for reason in actual.reasons)


def test_limits_are_those_that_are_given():
    strict = VerdictOptions(accepted_share=0.97, certain_edge_rms=0.05)
    actual = judge(CLEAR, 24, np.inf, options=strict)
    assert actual.reasons[0].startswith("only 95% of its visible edges match")
    with pytest.raises(ValueError, match="min_margin: expected a finite number, found nan"):
        VerdictOptions(min_margin=np.nan)
    with pytest.raises(ValueError, match=r"to grow between 0 and 1, found 0\.95 and 0\.9"):
        VerdictOptions(chance_probability=0.95)


def test_edges_may_be_off_by_the_tolerance_of_the_model():
    off = {"edge_rms": 1.25, "edges": 60}
    assert verdict(**off).decision == "open"
    assert verdict(**off, tolerance_px=0.5).decision == "accepted"
    assert verdict(**off | {"edge_rms": 1.5}, tolerance_px=0.5).decision == "open"


def test_in_a_third_view_something_may_be_before_the_object():
    good = {"explained": 0.75, "explained_in_view": (0.9, 0.9, 0.3)}
    assert verdict(**good).decision == "accepted"
    actual = verdict(**good | {"explained_in_view": (0.9, 0.4, 0.3)})
    assert actual.decision == "open"
    assert actual.reasons[0].startswith("view 1: 40%")
    assert verdict(**good | {"explained_in_view": (0.9, 0.9, np.nan)}).decision == "accepted"


def test_few_edges_are_enough_where_they_fit_exactly():
    few = {"edges": 5, "log_likelihood": 1.0}
    assert verdict(**few, edge_rms=0.1).decision == "accepted"
    assert "poses as good as this" in verdict(**few, edge_rms=0.4).reasons[0]


HIDDEN = {"explained": 0.6, "explained_in_view": (0.6, 0.6)}


def test_hidden_object_is_accepted_where_its_edges_fit_exactly():
    assert verdict(**HIDDEN).decision == "accepted"
    assert verdict(**HIDDEN | {"edge_rms": 0.6}).decision == "open"
    assert verdict(**HIDDEN | {"edges": 7, "edge_rms": 0.4}).decision == "open"
    assert verdict(**HIDDEN | {"explained": 0.45}).decision == "open"


def test_without_faces_nothing_can_be_taken_for_hidden():
    assert verdict(**HIDDEN | {"has_faces": False}).decision == "open"
    assert verdict(explained=0.9, has_faces=False).decision == "accepted"


@pytest.mark.parametrize(
    ("face", "distance", "words"),
    [
        (3, 0.0123, "larger than the model: moving face 3 outward by 12 mm"),
        (0, -0.004, "smaller than the model: moving face 0 inward by 4 mm"),
    ],
)
def test_a_solid_of_another_size_that_explains_more_is_named(face, distance, words):
    actual = verdict(**HIDDEN | {"moved": MovedFace(face, distance, 150.0)})
    assert actual.decision == "open"
    assert words in actual.reasons[0]
    assert verdict(**HIDDEN | {"moved": MovedFace(face, distance, 90.0)}).decision == "accepted"


def test_only_what_lacks_edges_may_be_of_another_size():
    assert may_be_another_size(CLEAR._replace(explained=0.85), DEFAULT_OPTIONS)
    assert not may_be_another_size(CLEAR, DEFAULT_OPTIONS)
    assert not may_be_another_size(CLEAR._replace(explained=0.85, has_faces=False), DEFAULT_OPTIONS)


def test_loosely_fitting_pose_needs_more_of_its_edges():
    assert verdict(explained=0.85).decision == "accepted"
    loose = verdict(explained=0.85, edge_rms=0.6)
    assert loose.decision == "open"
    assert "fit to 0.60 px" in loose.reasons[0]
    assert verdict(explained=0.9, edge_rms=0.6).decision == "accepted"


def test_clutter_is_excluded_only_by_enough_edges_that_fit_exactly():
    few = {"explained": 0.85, "edges": 7, "edge_rms": 0.3}
    assert verdict(**few).decision == "open"
    assert verdict(**few | {"explained": 0.9}).decision == "accepted"
    assert verdict(**few | {"edges": 14}).decision == "accepted"
    assert verdict(**few | {"edge_rms": 0.03}).decision == "accepted"


def test_one_picture_alone_has_to_be_fitted_closely():
    """Scale and tilt are free, so that a box of another size may be fitted to most edges."""
    loose = {"explained": 0.97, "edges": 9, "edge_rms": 0.6}
    assert verdict(**loose).decision == "accepted"
    actual = verdict(**loose | {"is_alone": True})
    assert actual.decision == "open"
    assert "too far for pictures from one direction" in actual.reasons[0]
