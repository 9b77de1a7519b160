import numpy as np
import pytest

from smartview_jax.localization import Chance, Evidence, judge
from smartview_jax.localization.chance import log_chance_of_exact_edges
from smartview_jax.localization.verdict import ACCEPTED_SHARE

CLUTTER = Chance(0.25, 0.08)

CLEAR = Evidence(
    explained=0.95,
    explained_in_view=(0.95, 0.95),
    visible_px=2000.0,
    edges=16,
    unconfirmed=0.0,
    partly_hidden=0.5,
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
        ({"edges": 4}, "rejected", "too few"),
        ({"log_likelihood": 20.0}, "rejected", "too few"),
        ({"chance": Chance(0.9, 0.1), "edge_rms": 0.9}, "rejected", "clutter explains as much"),
        ({"explained": 0.75, "unconfirmed": 0.2}, "open", "too little of one of its faces"),
        ({"edges": 6, "log_likelihood": 140.0}, "open", "are few"),
        ({"log_likelihood": 40.0}, "open", "are few"),
        ({"explained_in_view": (0.95, np.nan)}, "open", "only 1 of 2 views"),
        ({"explained_in_view": (0.95, 0.4)}, "open", "view 1: 40%"),
        ({"in_picture": 0.5}, "open", "only 50% of it are within a picture"),
        ({"in_front": 0.2}, "open", "only 20% of its edges are not behind other objects"),
        ({"edge_rms": 1.5}, "open", "1.50 px (RMS)"),
        ({"contrast": 0.2}, "open", "usual contrast"),
        ({"uncertainty": 0.06}, "open", "uncertain by 6%"),
        ({"margin": 2.0}, "open", "ambiguous"),
    ],
)
def test_each_weakness_is_named(changes, decision, words):
    found = verdict(**changes)
    assert found.decision == decision
    assert any(words in reason for reason in found.reasons)


def test_few_edges_are_enough_where_they_are_long_and_fit_exactly():
    assert verdict(edges=5, log_likelihood=200.0).decision == "accepted"
    assert verdict(edges=5, log_likelihood=200.0, edge_rms=0.55).decision == "open"


HIDDEN = {"explained": 0.6, "explained_in_view": (0.6, 0.6)}


def test_hidden_object_is_accepted_where_every_face_is_confirmed_and_its_edges_fit_exactly():
    assert verdict(**HIDDEN).decision == "accepted"
    assert verdict(**HIDDEN | {"edge_rms": 0.6}).decision == "open"
    assert verdict(**HIDDEN | {"edges": 7, "edge_rms": 0.4}).decision == "open"
    assert verdict(**HIDDEN | {"explained": 0.45}).decision == "open"


@pytest.mark.parametrize("unconfirmed", [0.2, np.nan])
def test_hidden_object_with_an_unconfirmed_face_is_accepted_only_where_something_hides_it(
    unconfirmed,
):
    """A model of another height has edges that are there and edges that are not."""
    hidden = HIDDEN | {"unconfirmed": unconfirmed, "partly_hidden": 0.7, "log_ends": 3.0}
    assert verdict(**hidden).decision == "accepted"
    assert verdict(**hidden | {"partly_hidden": 0.2}).decision == "open"
    found = verdict(**hidden | {"log_ends": 0.0})
    assert found.decision == "open"
    assert found.reasons == (
        "only 60% of its visible edges are in the pictures, and too little of one of its faces",
    )


def test_a_face_that_is_not_confirmed_needs_more_of_the_edges():
    """Another solid, of another size, explains most of what is seen."""
    assert verdict(explained=0.85, unconfirmed=0.05).decision == "accepted"
    assert verdict(explained=0.85, unconfirmed=np.nan).decision == "accepted"
    found = verdict(explained=0.85, unconfirmed=0.2)
    assert found.decision == "open"
    assert "too little of one of its faces" in found.reasons[0]
    assert verdict(explained=0.93, unconfirmed=0.2).decision == "accepted"
    assert verdict(explained=0.85, unconfirmed=0.2, log_ends=3.0).decision == "accepted"


def test_loosely_fitting_pose_needs_more_of_its_edges():
    assert verdict(explained=0.85).decision == "accepted"
    loose = verdict(explained=0.85, edge_rms=0.6)
    assert loose.decision == "open"
    assert "fit to 0.60 px" in loose.reasons[0]
    assert verdict(explained=0.9, edge_rms=0.6).decision == "accepted"


def test_one_picture_alone_needs_more_of_the_edges_or_more_that_fit_exactly():
    few = {"explained": 0.85, "edges": 8, "edge_rms": 0.3}
    assert verdict(**few).decision == "accepted"
    alone = few | {"explained_in_view": (0.85,)}
    assert verdict(**alone).decision == "open"
    assert verdict(**alone | {"explained": 0.9}).decision == "accepted"
    assert verdict(**alone | {"edges": 14, "edge_rms": 0.03}).decision == "accepted"


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
