import numpy as np
import pytest
from sessions import click_all, open_session, say

from smartview_jax.editor.conversation import Conversation
from smartview_jax.io import load_object_model

RAFTERS = ((0, 5), (2, 7), (3, 8), (4, 9))
"""Four of the five edges along the house, all of 50 mm."""


def house_with_edges(scene, views=(0, 1, 3)):
    session = open_session(scene, click_sigma=0.3)
    ids = click_all(session, scene, views)
    return session, ids, [session.add_edge(ids[a], ids[b]) for a, b in RAFTERS]


def click_elsewhere(session, scene, point, vertex, step):
    """Click a vertex where it would be seen if it were elsewhere: all views agree about it."""
    camera = session.calibration.camera
    for view in session.document.points[point]:
        matrix = session.geometry.camera_from_world[session.names.index(view)]
        place = matrix @ [*(scene.truth.vertices[vertex] + step), 1.0]
        session.click(view, np.asarray(camera.project(place[None, :3])[0])[0], point)


def test_a_wrong_click_is_named_where_three_views_can_tell(scene):
    session, ids, _ = house_with_edges(scene, (0, 1, 2, 3))
    assert session.disagreements() == []
    u, v = scene.click(3, 3)
    session.click("v4", (u + 6.0, v - 5.0), ids[3])
    (disagreement,) = session.disagreements()
    assert (disagreement.kind, disagreement.id, disagreement.suspects) == (
        "points",
        ids[3],
        ((ids[3], "v4"),),
    )
    assert "the click in v4 is most probably wrong, 7." in str(disagreement)
    residuals = session.estimates()[ids[3]].residuals
    assert disagreement.residuals == {(ids[3], w): np.hypot(*r) for w, r in residuals.items()}
    assert str(disagreement) in str(session)


def test_a_point_with_a_wrong_click_is_as_uncertain_as_it_is_wrong(scene):
    """The mean square of a position's error, in its standard deviations, is 3."""
    rng = np.random.default_rng(0)
    vertices = np.tile(np.arange(len(scene.truth.vertices)), 4)
    session = open_session(scene, click_sigma=0.3)
    points = []
    for vertex in vertices:
        clicks = {session.names[view]: scene.click(view, vertex, rng) for view in range(4)}
        wrong = session.names[rng.integers(4)]
        away = 8.0 * np.exp(1j * rng.uniform(0.0, 2.0 * np.pi))
        clicks[wrong] = (clicks[wrong][0] + away.real, clicks[wrong][1] + away.imag)
        points.append(clicks)
    errors = [
        (estimate.position - scene.truth.vertices[vertex], estimate.covariance)
        for vertex, estimate in zip(vertices, session.geometry.estimates(points), strict=True)
    ]
    mean = np.mean([error @ np.linalg.solve(covariance, error) for error, covariance in errors])
    assert 1.5 < mean < 6.0


def test_a_file_with_a_wrong_click_is_saved_with_a_warning(scene, tmp_path):
    with open_session(scene, tmp_path / "house.json") as session:
        ids = click_all(session, scene)
        page = Conversation(session)
        assert "disagree" not in page.save()["note"]
        u, v = scene.click(3, 3)
        session.click("v4", (u + 6.0, v - 5.0), ids[3])
        assert page.save()["note"].endswith("house.json; disagreements: 1")
        said = load_object_model(tmp_path / "house.json").provenance[1:]
        assert said == tuple(map(str, session.disagreements()))


def test_facts_that_cannot_hold_leave_the_points_where_the_clicks_are(scene):
    session, ids, _ = house_with_edges(scene)
    by_clicks = session.model().vertices
    pair = [[ids[a], ids[b]] for a, b in RAFTERS[:2]]
    facts = [session.add_constraint(kind, pair) for kind in ("parallel", "right_angle")]
    np.testing.assert_array_equal(session.model().vertices, by_clicks)
    assert session.problems() == {}
    assert session.distance(*pair[0])[1] > 0.0
    words = {(d.kind, d.id): d.words for d in session.disagreements()}
    assert {("constraints", fact) for fact in facts} <= set(words)
    assert "cannot hold together" in words["constraints", facts[0]]


def test_a_length_in_another_unit_leaves_the_points_where_the_clicks_are(scene):
    """Millimetres as metres."""
    session, ids, _ = house_with_edges(scene)
    by_clicks = session.model().vertices
    fact = session.add_constraint("known_length", [[ids[2], ids[7]]], value=50.0)
    np.testing.assert_array_equal(session.model().vertices, by_clicks)
    (words,) = [d.words for d in session.disagreements() if (d.kind, d.id) == ("constraints", fact)]
    assert "mm by the clicks alone, 50000.00 mm is stated" in words


def test_a_fact_holds_although_facts_about_other_points_cannot(scene):
    session, ids, _ = house_with_edges(scene)
    wrong, apart = [[ids[2], ids[7]]], [[ids[4], ids[9]]]
    wrong_fact = session.add_constraint("known_length", wrong, value=50.0)
    session.add_constraint("known_length", apart, value=0.05)
    length, sigma = session.distance(*apart[0])
    assert abs(length - 0.05) < 1e-9
    assert sigma < 1e-7
    assert {d.id for d in session.disagreements() if d.kind == "constraints"} == {wrong_fact}


def test_two_of_three_clicks_are_suspects_where_each_pair_with_the_third_agrees(scene):
    session, ids, _ = house_with_edges(scene)
    # Along the curve of v1 the wrong click in v4 agrees with v1, as the right one in v2 does.
    curve = session.curves("v1", session.document.points[ids[3]]["v1"])["v4"].pixels
    apart = np.linalg.norm(curve - scene.click(3, 3), axis=1)
    session.click("v4", curve[np.argmin(np.abs(apart - 12.0))], ids[3])
    (disagreement,) = session.disagreements()
    assert set(disagreement.suspects) == {(ids[3], "v2"), (ids[3], "v4")}
    assert (
        "is left out, so nobody can tell which: click the point in another view"
        in disagreement.words
    )


def test_of_two_clicks_nobody_can_tell_the_wrong_one(scene):
    session, ids, _ = house_with_edges(scene, (0, 1))
    # Across the curve, along which a wrong click of two is not seen at all.
    step = np.array(scene.click(1, 3)) - session.curves("v1", scene.click(0, 3))["v2"].pixels[-1]
    across = 8.0 * step[::-1] * [1.0, -1.0] / np.linalg.norm(step)
    session.click("v2", scene.click(1, 3) + across, ids[3])
    (disagreement,) = session.disagreements()
    assert set(disagreement.suspects) == {(ids[3], "v1"), (ids[3], "v2")}
    assert (
        "contradict each other; with two clicks nobody can tell which is wrong"
        in disagreement.words
    )


def test_an_edge_of_another_length_than_its_equals_is_named(scene):
    session, ids, edges = house_with_edges(scene)
    for pair in RAFTERS[1:]:
        say(session, "equal_length", *([ids[a], ids[b]] for a, b in (RAFTERS[0], pair)))
    assert session.disagreements() == []
    click_elsewhere(session, scene, ids[8], 8, [0.004, 0.0, 0.0])
    disagreements = session.disagreements()
    assert [
        (disagreement.kind, disagreement.id)
        for disagreement in disagreements
        if disagreement.kind != "constraints"
    ] == [("edges", edges[2])]
    assert disagreements[0].words.startswith("54.0")
    assert "mm by its own clicks, where the others say 50.0" in disagreements[0].words
    # All clicks of the point are off, so no single one explains it.
    assert disagreements[0].suspects == ()
    # Each fact of the four alone would let them agree, and is doubted too; the page says so.
    shown = Conversation(session).greeting()["parts"]["constraints"]
    assert {k for k, disagreement in shown.items() if "problem" in disagreement} == set(
        session.document.constraints
    )


def test_the_click_that_makes_a_stated_length_wrong_is_named(scene):
    session, ids, edges = house_with_edges(scene)
    u, v = scene.click(3, 2)
    session.click("v4", (u + 6.0, v - 5.0), ids[2])
    session.add_constraint("known_length", [[ids[2], ids[7]]], value=0.05)
    session.add_constraint("equal_length", [[ids[2], ids[7]], [ids[3], ids[8]]])
    by_kind = {disagreement.kind: disagreement for disagreement in session.disagreements()}
    assert by_kind["edges"].id == edges[1]
    assert {disagreement.suspects for disagreement in by_kind.values()} == {((ids[2], "v4"),)}
    # The point is uncertain along the other edges, whatever this one's length.
    off = np.linalg.norm(session.model().vertices[2] - scene.truth.vertices[2])
    assert 3e-4 < off < 2.0 * session.model().vertex_sigma[2]
    assert session.distance(ids[2], ids[7])[1] < 1e-6
    # A wrong fact is no click's fault.
    session.undo(), session.undo()
    session.click("v4", (u, v), ids[2])
    session.add_constraint("known_length", [[ids[2], ids[7]]], value=0.056)
    by_kind = {disagreement.kind: disagreement for disagreement in session.disagreements()}
    assert by_kind["edges"].suspects == ()
    assert "where 56.00 mm is stated; no single wrong click explains it" in by_kind["edges"].words


@pytest.mark.parametrize(("kind", "degrees"), [("right_angle", 85.43), ("parallel", 4.57)])
def test_an_angle_is_said_in_degrees(scene, kind, degrees):
    session, ids, _ = house_with_edges(scene)
    # 4 mm aside over 50 mm of length are 4.57 degrees.
    click_elsewhere(session, scene, ids[8], 8, [0.0, 0.004, 0.0])
    other = {"right_angle": (0, 1), "parallel": (4, 9)}[kind]
    say(session, kind, [ids[3], ids[8]], [ids[k] for k in other])
    disagreement = session.disagreements()[-1]
    said, _, sigma = disagreement.words.split(" ")[:3]
    # The floor's edge is along y.
    assert abs(float(said) - degrees) < 4.0 * float(sigma) < 2.0
