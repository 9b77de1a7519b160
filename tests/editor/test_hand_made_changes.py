"""Test that a change that a page made by hand is answered, and never keeps a file from opening."""

from sessions import drawn_house, open_session

from smartview_jax.editor.conversation import Conversation

HAND_MADE = [
    {"do": "change_face", "loop": [0, 1, 999]},
    {"do": "change_face", "loop": [0, 0, 1]},
    {"do": "change_face", "loop": []},
    {"do": "change_face", "name": 7},
    {"do": "change_face", "name": "a\nb"},
    {"do": "change_face", "name": "x" * 201},
    {"do": "change_face", "name": "#1"},
    {"do": "change_face", "name": " a"},
    {"do": "rename", "name": "../x"},
    {"do": "change_face", "graspable": "perhaps"},
    {"do": "add_point", "clicks": [1, 2]},
    {"do": "add_edge", "ends": [1e999, 0]},
    {"do": "add_constraint", "kind": ["length"], "items": [[0, 1]]},
    {"do": "add_constraint", "kind": "length", "items": [[0, 1]], "value": 1.0, "sigma": -1.0},
    {"do": "change_face", "graspable": 1},
    {"do": "change_face", "loop": ["0", "1", "2"]},
    {"do": "change_face", "loop": [0.2, 1.0, 2.0]},
    {"do": "add_edge", "ends": [0.7, True]},
    {"do": "add_edge", "ends": "07"},
    {"do": "delete", "kind": "points", "id": True},
    {"do": "delete", "kind": "points", "id": 2**70},
    {"do": "click", "point": 0, "view": "v1", "pixel": "12"},
    {"do": "click", "point": 0, "view": "v1", "pixel": [True, 2]},
    {"do": "click", "point": 0, "view": "v1", "pixel": [10**400, 2]},
    {"do": "confirm_symmetry", "confirmed": 1, "order": 2},
    {"do": "confirm_symmetry", "confirmed": True, "order": True},
    {"do": "add_grasp", "face": 10, "depth": 1e300},
    {"do": "add_grasp", "face": 10, "opening": True},
    {"do": "add_grasp", "face": 10, "offset": ["0", "0"]},
    {"do": "add_constraint", "kind": "known_length", "items": [[0, 1]], "value": 1e300},
    {"do": "several", "changes": 3},
    {"do": "several", "changes": [[]]},
]


def test_hand_made_changes_are_answered_and_not_kept(scene, tmp_path):
    """Each is answered with an error, the document stays as it was, and the file opens again."""
    path = tmp_path / "house.json"
    with open_session(scene, path) as session:
        drawn_house(session, scene)
        face, before = min(session.document.faces), session.document
        conversation = Conversation(session)
        for change in HAND_MADE:
            content = {"id": face, **change} if change["do"] == "change_face" else change
            answer = conversation.answer({**content, "message": 1})
            assert answer["type"] == "error", change
            assert answer["text"], change
            assert session.document is before, change
    with open_session(scene, path) as session:
        assert session.document == before


def test_any_exception_is_an_answer(scene, monkeypatch):
    session = open_session(scene)
    conversation = Conversation(session)

    def broken(*_, **__):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(session, "curves", broken)
    answer = conversation.answer({"do": "hover", "view": "v1", "pixel": [9.0, 9.0], "message": 4})
    assert answer == {"type": "error", "text": "by zero", "reply_to": 4}
