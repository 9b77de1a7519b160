"""What the page is told, without a page."""

import json

import numpy as np
import pytest

from smartview_jax.editor import Conversation, ModelSession
from smartview_jax.io import load_object_views, object_sample_folder
from smartview_jax.simulation import paper_calibration


@pytest.fixture
def session(scene):
    return ModelSession(scene.calibration, scene.base_from_tool, scene.pictures)


def ask(conversation, **message):
    """An answer, as it comes through JSON, which has no NaN."""
    return json.loads(json.dumps(conversation.answer(message), allow_nan=False))


def made(session, scene):
    """All vertices and faces, through the conversation alone."""
    conversation = Conversation(session)
    ask(conversation, do="hello", message=0)
    for vertex in range(10):
        clicks = {name: scene.click(k, vertex) for k, name in enumerate(session.names[:3])}
        ask(conversation, do="add_point", clicks=clicks)
    for face in scene.truth.faces:
        answer = ask(conversation, do="add_face", loop=list(face.loop))
        assert answer["type"] == "update", answer
    return conversation


def test_an_answer_has_what_changed_and_no_more(session, scene):
    conversation = made(session, scene)
    answer = ask(conversation, do="click", point=3, view="v4", pixel=scene.click(3, 3), message=5)
    assert answer["reply_to"] == 5
    assert list(answer["parts"]["points"]) == ["3"]
    joined = [e for e in session.document.edges.values() if 3 in e]
    assert len(answer["parts"]["edges"]) == len(joined) == 3
    entry = answer["parts"]["points"]["3"]
    np.testing.assert_allclose(entry["at"], scene.truth.vertices[3], atol=1e-5)
    assert set(entry["residuals"]) == {"v1", "v2", "v3", "v4"}
    u, v, long, short, _ = entry["in"][4]
    assert np.hypot(u - scene.pixels[4, 3, 0], v - scene.pixels[4, 3, 1]) < 0.05
    assert long >= short > 0.0
    answer = ask(conversation, do="delete", kind="points", id=3)
    assert answer["parts"]["points"] == {"3": None}
    again = ask(conversation, do="undo")
    assert list(again["parts"]["points"]) == ["3"]
    assert len(again["parts"]["faces"]) == 3


def test_another_page_is_brought_up_to_date(session, scene):
    one, two = Conversation(session), Conversation(session)
    ask(one, do="hello")
    ask(two, do="hello")
    ask(one, do="add_point", clicks={"v1": [3.0, 4.0]})
    assert list(two.update()["parts"]["points"]) == [0]
    assert two.update()["parts"]["points"] == {}


def test_grasps_are_placed_and_turned_by_the_mouse(session, scene):
    conversation = made(session, scene)
    roof = scene.truth.faces[4].loop
    middle = scene.pixels[0, list(roof)].mean(axis=0).tolist()
    answer = ask(conversation, do="grasp_at", view="v1", pixel=middle)
    grasp = answer["new"]
    entry = answer["parts"]["grasps"][str(grasp)]
    assert entry["opening_mm"] == pytest.approx(1.2 * entry["width_mm"], abs=0.02)
    # Turned towards the middle of an edge, the fingers open across it.
    a, b = roof[0], roof[1]
    towards = scene.pixels[0, [a, b]].mean(axis=0).tolist()
    preview = ask(conversation, do="turn_grasp", grasp=grasp, view="v1", pixel=towards)
    assert preview["type"] == "preview"
    assert session.document.grasps[grasp].angle == pytest.approx(np.pi / 2)
    ask(conversation, do="turn_grasp", grasp=grasp, view="v1", pixel=towards, commit=True)
    made_grasp = session.model().grasps[0]
    edge = scene.truth.vertices[b] - scene.truth.vertices[a]
    across = abs(made_grasp.opening_direction @ edge) / np.linalg.norm(edge)
    assert across < 0.02
    answer = ask(conversation, do="change_grasp", id=grasp, opening=0.2)
    assert answer["parts"]["grasps"][str(grasp)]["opening_mm"] == 200.0
    outside = ask(conversation, do="grasp_at", view="v1", pixel=[2.0, 2.0])
    assert "no face here" in outside["text"]


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ({"do": "fly"}, "unknown command"),
        ({}, "unknown command"),
        ({"do": "hover", "view": "v7", "pixel": [1, 1]}, "no view 'v7'"),
        ({"do": "hover", "view": "v1", "pixel": "here"}, "two numbers"),
        ({"do": "hover", "view": "v1"}, "missing"),
        ({"do": "add_point", "clicks": {"v1": [1, 1], "v2": [None, 2]}}, "two numbers"),
        ({"do": "distance", "a": 5, "b": 6}, "no point 5"),
        ({"do": "save"}, "this session has no file"),
        ({"do": "accept", "points": [3]}, "no proposed point 3"),
        ({"do": "several", "changes": [{"do": "add_edge", "ends": [0, 1]}]}, "no point 0"),
        ({"do": "several", "changes": [{"do": "add_point", "clicks": {"v": [1, 1]}}]}, "no view"),
    ],
)
def test_what_a_page_should_not_ask_is_an_error(session, message, said):
    conversation, before = Conversation(session), session.document
    answer = ask(conversation, **message, message=1)
    assert answer["type"] == "error"
    assert said in answer["text"]
    assert session.document is before


@pytest.fixture
def example_session():
    """The package's pictures of the example's object, and the camera that took them."""
    views = load_object_views(object_sample_folder() / "object")
    return ModelSession(paper_calibration(), views.command, views.pictures)


def test_a_rectangle_limits_what_is_proposed(example_session):
    session = example_session
    conversation = Conversation(session)
    ask(conversation, do="hello")
    everywhere = ask(conversation, do="propose")["offer"]["points"]
    places = np.array([p["in"][0] for p in everywhere if p["in"][0] is not None])
    left, top = np.median(places, axis=0)
    right, bottom = places.max(axis=0) + 5.0
    rectangle = [float(x) for x in (left, top, right, bottom)]
    offer = ask(conversation, do="propose", rectangles={"v1": rectangle})["offer"]["points"]
    assert 0 < len(offer) < 0.6 * len(everywhere)
    seen = np.array([p["in"][0] for p in offer if p["in"][0] is not None])
    assert (seen > [left - 2.0, top - 2.0]).all()
    # In the library also a box, in the world.
    box = np.array([[-1.0, -1.0, 0.004], [1.0, 1.0, 1.0]])
    points = session.propose(box=box).points
    assert 0 < len(points) < len(everywhere)
    for rectangles, said in (
        ({"v9": rectangle}, "no view 'v9'; the views are v1, v2"),
        ({"v2": [5, 5, 5, 9]}, "region: view v2: expected u 5 below 5"),
        ({"v2": "all"}, "region: view v2: a rectangle is four numbers"),
        ({"v2": [None, 1, 2, 3]}, "region: view v2: a rectangle is four numbers"),
    ):
        answer = ask(conversation, do="propose", rectangles=rectangles)
        assert answer["type"] == "error"
        assert said in answer["text"]
    # What was refused leaves the last offer.
    assert session.proposals.points == points


def test_proposals_are_accepted_one_by_one(example_session):
    session = example_session
    conversation = Conversation(session)
    ask(conversation, do="hello")
    answer = ask(conversation, do="propose")
    offer = answer["offer"] if "offer" in answer else pytest.fail(answer["text"])
    assert len(offer["points"]) >= 6
    first, second = (point["number"] for point in offer["points"][:2])
    answer = ask(conversation, do="accept", points=[first])
    assert len(answer["parts"]["points"]) == 1
    answer = ask(conversation, do="reject", points=[second])
    assert {first, second}.isdisjoint(p["number"] for p in answer["offer"]["points"])
    rest = [point["number"] for point in answer["offer"]["points"]]
    ask(conversation, do="accept", points=rest)
    assert len(session.document.points) == len(offer["points"]) - 1
    assert session.document.edges
    # Undone together; what is there already is not offered again.
    session.undo()
    assert len(session.document.points) == 1
    again = ask(conversation, do="propose")["offer"]
    assert first not in [point["number"] for point in again["points"]]
    (estimate,) = session.estimates().values()
    assert len(estimate.residuals) >= 3
    assert np.abs(list(estimate.residuals.values())).max() < 2.0
