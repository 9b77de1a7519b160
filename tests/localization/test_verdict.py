import numpy as np
import pytest

from smartview_jax.localization import Chance, Evidence, judge
from smartview_jax.localization.chance import log_chance_of_exact_edges
from smartview_jax.localization.moved_faces import MovedFace
from smartview_jax.localization.verdict import ACCEPTED_SHARE, may_be_another_size

CLUTTER = Chance(0.25, 0.08)

CLEAR = Evidence(
    explained=0.95,
    explained_in_view=(0.95, 0.95),
    visible_px=2000.0,
    is_alone=False,
    edges=16,
    has_faces=True,
    edge_rms=0.1,
    contrast=1.5,
    in_picture=1.0,
    in_front=1.0,
    log_likelihood=300.0,
    log_exactness=0.0,
)


def verdict(chance=CLUTTER, margin=np.inf, uncertainty=0.0, **changes):
    evidence = CLEAR._replace(**changes)
    exactness = log_chance_of_exact_edges(np.full(evidence.edges, evidence.edge_rms))
    evidence = evidence._replace(log_exactness=exactness)
    return judge(evidence, chance, 24, margin, uncertainty=uncertainty)


def test_clear_pose_is_accepted():
    assert verdict().decision == "accepted"
    assert not verdict().reasons


@pytest.mark.parametrize(
    ("changes", "decision", "words"),
    [
        ({"explained": 0.3}, "rejected", "only 30% of its visible edges"),
        ({"edges": 4}, "rejected", "too little evidence"),
        ({"log_likelihood": 20.0}, "rejected", "too little evidence"),
        (
            {"chance": Chance(0.9, 0.1), "edge_rms": 0.9},
            "rejected",
            "background clutter matches almost as well",
        ),
        ({"explained": 0.75, "edge_rms": 0.6}, "open", "only 75% of its visible edges"),
        ({"edges": 6, "log_likelihood": 140.0}, "open", "little evidence"),
        ({"log_likelihood": 30.0}, "open", "little evidence"),
        ({"explained_in_view": (0.95, np.nan)}, "open", "only 1 of 2 views"),
        ({"explained_in_view": (0.95, 0.4)}, "open", "view 1: 40%"),
        ({"in_picture": 0.5}, "open", "only 50% of its vertices are within a picture"),
        ({"in_front": 0.2}, "open", "80% of its edges are occluded by other objects"),
        ({"edge_rms": 1.5}, "open", "1.50 px (RMS)"),
        ({"contrast": 0.2}, "open", "low contrast: its edges have 20%"),
        ({"uncertainty": 0.06}, "open", "uncertain by 6%"),
        ({"margin": 2.0}, "open", "ambiguous"),
    ],
)
def test_each_weakness_is_named(changes, decision, words):
    found = verdict(**changes)
    assert found.decision == decision
    assert any(words in reason for reason in found.reasons)


def test_in_a_third_view_something_may_be_before_the_object():
    good = {"explained": 0.75, "explained_in_view": (0.9, 0.9, 0.3)}
    assert verdict(**good).decision == "accepted"
    found = verdict(**good | {"explained_in_view": (0.9, 0.4, 0.3)})
    assert found.decision == "open"
    assert found.reasons[0].startswith("view 1: 40%")
    assert verdict(**good | {"explained_in_view": (0.9, 0.9, np.nan)}).decision == "accepted"


def test_few_edges_are_enough_where_they_are_long_and_fit_exactly():
    assert verdict(edges=5, log_likelihood=200.0).decision == "accepted"
    assert verdict(edges=5, log_likelihood=200.0, edge_rms=0.55).decision == "open"


def test_few_edges_are_enough_where_their_exactness_alone_excludes_chance():
    few = {"edges": 6, "log_likelihood": 80.0}
    assert verdict(**few, edge_rms=0.03).decision == "accepted"
    assert verdict(**few, edge_rms=0.08).decision == "open"


HIDDEN = {"explained": 0.6, "explained_in_view": (0.6, 0.6)}


def test_hidden_object_is_accepted_where_its_edges_fit_exactly():
    assert verdict(**HIDDEN).decision == "accepted"
    assert verdict(**HIDDEN | {"edge_rms": 0.6}).decision == "open"
    assert verdict(**HIDDEN | {"edges": 7, "edge_rms": 0.4}).decision == "open"
    assert verdict(**HIDDEN | {"explained": 0.45}).decision == "open"


def test_without_faces_nothing_can_be_taken_for_hidden():
    assert verdict(**HIDDEN | {"has_faces": False}).decision == "open"
    assert verdict(explained=0.85, has_faces=False).decision == "accepted"


@pytest.mark.parametrize(
    ("face", "distance", "words"),
    [
        (3, 0.0123, "larger than the model: moving face 3 outward by 12 mm"),
        (0, -0.004, "smaller than the model: moving face 0 inward by 4 mm"),
    ],
)
def test_a_solid_of_another_size_that_explains_more_is_named(face, distance, words):
    found = verdict(**HIDDEN | {"moved": MovedFace(face, distance, 150.0)})
    assert found.decision == "open"
    assert words in found.reasons[0]
    assert verdict(**HIDDEN | {"moved": MovedFace(face, distance, 90.0)}).decision == "accepted"


def test_where_clutter_explains_much_another_size_has_to_explain_more():
    moved = HIDDEN | {"edges": 22, "edge_rms": 0.05, "moved": MovedFace(3, 0.01, 150.0)}
    assert verdict(**moved).decision == "open"
    assert verdict(Chance(0.5, 0.05), **moved).decision == "accepted"


def test_only_what_lacks_edges_may_be_of_another_size():
    assert may_be_another_size(CLEAR._replace(explained=0.85))
    assert not may_be_another_size(CLEAR)
    assert not may_be_another_size(CLEAR._replace(explained=0.85, has_faces=False))


def test_loosely_fitting_pose_needs_more_of_its_edges():
    assert verdict(explained=0.85).decision == "accepted"
    loose = verdict(explained=0.85, edge_rms=0.6)
    assert loose.decision == "open"
    assert "fit to 0.60 px" in loose.reasons[0]
    assert verdict(explained=0.9, edge_rms=0.6).decision == "accepted"


def test_one_picture_alone_needs_more_of_the_edges_or_more_that_fit_exactly():
    few = {"explained": 0.85, "edges": 8, "edge_rms": 0.3}
    assert verdict(**few).decision == "accepted"
    alone = few | {"is_alone": True}
    assert verdict(**alone).decision == "open"
    assert verdict(**alone | {"explained": 0.9}).decision == "accepted"
    assert verdict(**alone | {"edges": 14, "edge_rms": 0.03}).decision == "accepted"
    assert verdict(Chance(0.1, 0.02), **alone).decision == "open"


def test_one_picture_alone_has_to_be_fitted_closely():
    """Scale and tilt are free, so that a box of another size may be fitted to most edges."""
    loose = {"explained": 0.97, "edges": 9, "edge_rms": 0.6}
    assert verdict(**loose).decision == "accepted"
    found = verdict(**loose | {"is_alone": True})
    assert found.decision == "open"
    assert "too far for pictures from one direction" in found.reasons[0]


def test_little_edge_length_is_enough_where_nearly_all_of_it_fits_exactly():
    small = {"log_likelihood": 38.0, "edges": 9, "edge_rms": 0.3}
    assert verdict(**small).decision == "accepted"
    assert "little evidence" in verdict(**small | {"explained": 0.86}).reasons[0]
    assert "little evidence" in verdict(**small | {"edge_rms": 0.6}).reasons[0]
    assert "little evidence" in verdict(**small | {"log_likelihood": 30.0}).reasons[0]


def test_exact_edges_count_against_chance():
    """Where clutter explains much, so many edges that fit exactly are still no accident."""
    dense = Chance(0.72, 0.12)
    assert verdict(dense, explained=0.97).decision == "accepted"
    assert any("by chance" in r for r in verdict(dense, explained=0.97, edge_rms=0.6).reasons)


def test_what_fits_exactly_is_not_rejected_for_what_chance_explains():
    exact = CLEAR._replace(edges=22, edge_rms=0.05, log_exactness=-40.0)
    dense = Chance(0.9, 0.1)
    assert judge(exact, dense, 24, np.inf).decision == "accepted"
    assert judge(exact._replace(log_exactness=-5.0), dense, 24, np.inf).decision == "rejected"


def test_accepted_share_is_not_met_by_chance():
    assert CLUTTER.probability_above(ACCEPTED_SHARE) < 1e-6
    assert 0.4 < Chance(0.5, 0.1).probability_above(0.5) < 0.6
