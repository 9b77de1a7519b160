import numpy as np
import pytest
from sessions import click_all, drawn_house, open_session, say

from smartview_jax.editor.entries import edge_entries
from smartview_jax.io import load_object_model
from smartview_jax.modeling import KnownLength, SamePlane, dimension


def test_what_a_person_knows_moves_the_points(session, scene):
    ids = click_all(session, scene, views=(0, 1))
    loose, sigma = session.distance(ids[0], ids[5])
    assert loose != pytest.approx(0.05, abs=1e-6)
    session.change(
        {"do": "add_constraint", "kind": "known_length", "items": [[ids[0], ids[5]]], "value": 0.05}
    )
    known, remaining = session.distance(ids[0], ids[5])
    assert known == pytest.approx(0.05, abs=1e-9)
    assert remaining < sigma
    (verdict,) = session.verdicts().values()
    assert not verdict.contradicts
    floor = [ids[v] for v in scene.truth.faces[2].loop]
    session.change({"do": "add_constraint", "kind": "on_table", "items": [floor]})
    positions = [session.estimates()[point].position[2] for point in floor]
    np.testing.assert_allclose(positions, 0.0, atol=1e-9)
    # A length that is wrong by a fifth contradicts the clicks, and is named.
    session.change(
        {
            "do": "add_constraint",
            "kind": "known_length",
            "items": [[ids[2], ids[7]]],
            "value": 0.06,
            "sigma": 1e-4,
        }
    )
    doubted = [k for k, one in session.verdicts().items() if one.contradicts]
    assert doubted == [session.document.next_id - 1]
    session.undo()
    assert not any(one.contradicts for one in session.verdicts().values())


@pytest.mark.parametrize(
    ("fact", "said"),
    [
        ({"kind": "round", "items": [[0, 1]]}, "expected one of the facts same_plane"),
        ({"kind": "same_plane", "items": [[0, 1, 2]]}, "expected 4 or more points"),
        ({"kind": "parallel", "items": [[0, 1]]}, "expected 2 or more edges"),
        ({"kind": "known_length", "items": [[0, 1]]}, "the length is missing"),
        ({"kind": "known_length", "items": [[0, 1]], "value": -1.0}, "a known length is above 0"),
        ({"kind": "known_length", "items": [[0, 77]], "value": 1.0}, "no point 77"),
    ],
)
def test_a_fact_that_cannot_be_is_refused(session, scene, fact, said):
    click_all(session, scene, views=(0, 1))
    before = session.document
    with pytest.raises(ValueError, match=said):
        session.change({"do": "add_constraint", **fact})
    assert session.document is before


def test_a_symmetry_is_found_confirmed_and_saved(session, scene, tmp_path):
    assert session.symmetry() is None
    with pytest.raises(ValueError, match="fewer than three vertices"):
        session.confirm_symmetry()
    drawn_house(session, scene)
    # The house is the same after half a turn about the vertical through the middle of its ridge.
    actual = session.symmetry()
    assert actual.order == 2
    assert not actual.confirmed
    (axis,) = actual.axes
    np.testing.assert_allclose(axis.direction, [0, 0, 1], atol=0.01)
    assert session.symmetry_said is None
    session.save()
    assert load_object_model(tmp_path / "house.json").symmetry is None
    session.confirm_symmetry()
    assert session.symmetry().confirmed
    session.save()
    symmetry = load_object_model(tmp_path / "house.json").symmetry
    assert symmetry.order == 2
    assert symmetry.confirmed
    session.undo()
    assert session.symmetry_said is None


def test_a_refused_symmetry_is_saved_as_none(session, scene, tmp_path):
    """Whoever localises the object then tells its two poses apart."""
    drawn_house(session, scene)
    session.confirm_symmetry(False)
    assert session.symmetry_said is False
    assert not session.symmetry().confirmed
    session.save()
    symmetry = load_object_model(tmp_path / "house.json").symmetry
    assert symmetry.order == 1
    assert symmetry.confirmed


def test_an_edit_that_changes_the_symmetry_ends_what_was_said_of_it(session, scene, tmp_path):
    ids = drawn_house(session, scene)
    session.confirm_symmetry()
    # A diagonal on one wall only.
    a, _, c, _ = scene.truth.faces[3].loop
    session.add_edge(ids[a], ids[c])
    assert session.symmetry().order == 1
    assert session.symmetry_said is None
    assert session.model().symmetry is None
    session.undo()
    assert session.symmetry_said is True
    # Points that are left on one line have none, and that is no error.
    for vertex in range(2, len(ids)):
        session.delete("points", ids[vertex])
    assert session.symmetry() is None
    assert session.model().symmetry is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"confirmed": "yes"}, "confirmed: expected true, false or null, found 'yes'"),
        ({"confirmed": True, "order": 0}, "the order of a symmetry is 1 or more, found 0"),
        ({}, "confirm_symmetry: missing"),
    ],
)
def test_what_cannot_be_said_of_a_symmetry_is_refused(session, change, said):
    with pytest.raises(ValueError, match=said):
        session.change({"do": "confirm_symmetry", **change})


def test_the_deviation_of_a_length_is_that_of_both_points_together(session, scene, tmp_path):
    ids = click_all(session, scene, views=(0, 1))
    say(session, "known_length", (ids[0], ids[5]), value=0.05)
    say(session, "same_plane", [ids[v] for v in scene.truth.faces[2].loop])
    # Each of the two is uncertain, and their distance is not.
    estimates = session.estimates()
    assert np.sqrt(np.trace(estimates[ids[0]].covariance)) > 1e-4
    assert session.distance(ids[0], ids[5])[1] < 1e-7
    # The distances of many pairs follow the refinement's joint covariance.
    points = list(session.document.points.values())
    constraints = [
        KnownLength((0, 5), 0.05),
        SamePlane(tuple(scene.truth.faces[2].loop)),
    ]
    _, features, _ = session.geometry.refined(points, constraints)
    pairs = [(0, 1), (0, 4), (1, 6), (5, 9)]
    for (a, b), actual in zip(
        pairs, session.distances([(ids[a], ids[b]) for a, b in pairs]), strict=True
    ):
        np.testing.assert_allclose(actual, dimension(features, a, b), rtol=1e-6)
    # The saved file gives the same distances, because it keeps the correlations.
    session.save()
    model = load_object_model(tmp_path / "house.json")
    assert model.covariance.shape == (30, 30)
    for a, b in pairs:
        np.testing.assert_allclose(
            model.distance(a, b), session.distance(ids[a], ids[b]), rtol=1e-6
        )
    # And what the page is told.
    ids_of = session.add_edge(ids[0], ids[5])
    entry = edge_entries({ids_of: (ids[0], ids[5])}, session.estimates(), session)[ids_of]
    assert (entry["mm"], entry["sigma_mm"]) == (50.0, 0.0)


def test_deviations_of_lengths_under_constraints_are_those_of_repeated_clicks(scene):
    """The sum of both points' own covariances would be far too large."""
    squares, apart = [], []
    for seed in range(12):
        session = open_session(scene, click_sigma=0.3)
        vertices = (0, 5, 4, 9)
        clicked = click_all(session, scene, views=(0, 1), seed=seed, vertices=vertices)
        ids = dict(zip(vertices, clicked, strict=True))
        # What the person knows is off by what its sigma says.
        value = 0.05 + 3e-5 * np.random.default_rng((seed, 1)).standard_normal()
        say(session, "known_length", (ids[0], ids[5]), value=value, sigma=3e-5)
        say(session, "equal_length", (ids[0], ids[5]), (ids[4], ids[9]))
        estimates = session.estimates()
        for a, b in ((0, 5), (4, 9)):
            truth = np.linalg.norm(scene.truth.vertices[b] - scene.truth.vertices[a])
            length, sigma = session.distance(ids[a], ids[b])
            squares.append(((length - truth) / sigma) ** 2)
            n = (estimates[ids[b]].position - estimates[ids[a]].position) / length
            own = estimates[ids[a]].covariance + estimates[ids[b]].covariance
            apart.append((length - truth) ** 2 / (n @ own @ n))
    # Both lengths are one number: 12 squares, whose mean has a standard deviation of 0.41.
    assert 0.4 < np.mean(squares) < 1.8
    assert np.mean(apart) < 0.2
