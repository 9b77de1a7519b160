import pytest
from editor_scene import house
from sessions import click_all

from smartview_jax.editor.conversation import Conversation


def test_a_name_is_checked_before_it_is_sent(session, scene):
    ids = click_all(session, scene, views=(0, 1))
    faces = [session.add_face([ids[v] for v in face.loop], "") for face in house().faces[:3]]
    session.change({"do": "change_face", "id": faces[0], "name": "gable"})
    page, before = Conversation(session), session.document

    def problem(name, **change):
        change = {"do": "change_face", "id": faces[1], **change, "name": name}
        return page.answer({"do": "check", "change": change})["problem"]

    for name in ("", "wall", "name with spaces", "Gable"):
        assert problem(name) == ""
    assert problem("gable", id=faces[0]) == ""
    taken = f"face: the name 'gable' belongs to faces {faces[0]}, {faces[1]}"
    assert problem("gable") == taken
    assert "not printable" in problem("tab\there")
    assert "lead out of its folder" in problem("../gable")
    assert session.document is before
    # The change itself is refused for the same reason.
    with pytest.raises(ValueError, match=taken):
        session.change({"do": "change_face", "id": faces[1], "name": "gable"})
    # Several at once, too; but an earlier file may have two of one name.
    both = [{"do": "change_face", "id": k, "name": "wall"} for k in faces[1:]]
    with pytest.raises(ValueError, match="the name 'wall'"):
        session.change({"do": "several", "changes": both})
    assert session.document is before
