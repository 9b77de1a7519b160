import json
import os
import signal
import subprocess
import sys

import pytest
from sessions import click_all, open_session

from smartview_jax.editor import ModelSession


def test_a_file_that_is_no_journal_is_named_with_its_line(scene, tmp_path):
    path = tmp_path / "house.json"
    journal = tmp_path / "house.json.journal"
    for text, said in (
        ('{"name": "mine"}\n', r"journal: line 1: not a journal of the object-model editor"),
        ("some notes\nof mine\n", r"journal: line 1 is not a change: b'some notes'"),
    ):
        journal.write_text(text)
        with pytest.raises(ValueError, match=said):
            open_session(scene, path)
        # It is somebody's file: it is left as it was, and so is the lock.
        assert journal.read_text() == text
        assert not (tmp_path / "house.json.lock").exists()


def test_a_change_that_was_edited_in_the_journal_is_named_with_its_line(scene, tmp_path):
    path = tmp_path / "house.json"
    with open_session(scene, path) as session:
        for vertex in (0, 3):
            session.click("v1", scene.click(0, vertex))
        session.add_edge(0, 1)
    journal = tmp_path / "house.json.journal"
    journal.write_text(journal.read_text().replace('"ends": [0, 1]', '"ends": [0, 7]'))
    with pytest.raises(ValueError, match=r"journal: line 4: no point 7"):
        open_session(scene, path)


def test_a_session_goes_on_where_it_ended(scene, tmp_path):
    path = tmp_path / "house.json"
    with open_session(scene, path) as first:
        click_all(first, scene, views=(0, 1))
        first.undo()
        first.undo()
        first.redo()
        expected = first.document
    with open_session(scene, path) as second:
        assert second.document == expected
        assert second.can_redo
        assert second.notes == []
        second.save()
    with open_session(scene, path) as third:
        assert third.is_saved


def test_a_torn_last_line_is_cut_off(scene, tmp_path):
    path = tmp_path / "house.json"
    with open_session(scene, path) as first:
        point = first.click("v1", (10.0, 20.0))
        expected = first.document
        first.click("v2", (30.0, 40.0), point)
    journal = tmp_path / "house.json.journal"
    whole = journal.read_bytes()
    last = whole.splitlines(keepends=True)[-1]
    # With its line end alone missing it would be whole; see `test_journal.py`.
    for kept in range(2, len(last)):
        journal.write_bytes(whole[: len(whole) - kept])
        with open_session(scene, path) as again:
            assert again.document == expected
            assert kept == len(last) or "the last change is lost" in again.notes[0]
            again.click("v3", (50.0, 60.0), point)
        if kept in (2, len(last) - 1):
            with open_session(scene, path) as after:
                assert set(after.document.points[point]) == {"v1", "v3"}
    # Not so in the middle: nothing may be guessed there.
    journal.write_bytes(whole.replace(b'"do"', b"{do", 1))
    with pytest.raises(ValueError, match=r"journal: line 2 is not a change"):
        open_session(scene, path)
    assert not (tmp_path / "house.json.lock").exists()


def test_two_editors_on_one_file_are_refused(scene, tmp_path):
    path = tmp_path / "house.json"
    with (
        open_session(scene, path),
        pytest.raises(BlockingIOError, match=rf"open in another editor: process {os.getpid()}"),
    ):
        open_session(scene, path)
    open_session(scene, path).close()
    lock = tmp_path / "house.json.lock"
    lock.write_text(json.dumps({"pid": 1, "host": "elsewhere", "started": "1"}))
    with pytest.raises(BlockingIOError, match=r"process 1 on elsewhere\. .* remove .*json\.lock"):
        open_session(scene, path)


@pytest.mark.parametrize("pid", ["ended", "reused"])
def test_the_lock_of_a_killed_process_is_stale(scene, tmp_path, pid):
    import socket

    path = tmp_path / "house.json"
    ended = subprocess.Popen(["true"])
    ended.wait()
    number = ended.pid if pid == "ended" else os.getpid()
    content = {"pid": number, "host": socket.gethostname(), "started": "0"}
    (tmp_path / "house.json.lock").write_text(json.dumps(content))
    open_session(scene, path).close()


KILLED = """
import json, sys, types
# The parts of the editor that keep a session need nothing of the rest, which takes seconds to load.
import smartview_jax
editor = types.ModuleType("smartview_jax.editor")
editor.__path__ = [smartview_jax.__path__[0] + "/editor"]
sys.modules["smartview_jax.editor"] = editor
from pathlib import Path
from smartview_jax.editor.document import apply_change
from smartview_jax.editor.edit_history import EditHistory

history = EditHistory(Path(sys.argv[1]), json.loads(sys.argv[2]))
for k in range(100000):
    change = {"do": "add_point", "clicks": {"v1": [k % 600, 20.0]}}
    history.change(change, apply_change(history.document, change))
    print(k, flush=True)
"""


def test_a_killed_process_loses_nothing(scene, tmp_path):
    """SIGKILL in the middle of clicking; every click that was answered is there."""
    path = tmp_path / "house.json"
    open_session(scene, path).close()
    header = json.loads(path.with_name("house.json.journal").read_text())
    del header["smartview_journal"]
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path), json.dumps(header)],
        stdout=subprocess.PIPE,
        text=True,
    )
    answered = [int(process.stdout.readline()) for _ in range(20)]
    process.send_signal(signal.SIGKILL)
    answered += [int(line) for line in process.stdout.read().split("\n") if line.strip()]
    process.wait()
    process.stdout.close()
    with open_session(scene, path) as session:
        # One more may be on the disk that was not answered yet.
        assert len(session.document.points) - len(answered) in (0, 1)
        assert session.document.points[answered[-1]] == {"v1": (answered[-1] % 600, 20.0)}


def test_the_journal_of_other_views_is_refused(scene, tmp_path):
    path = tmp_path / "house.json"
    open_session(scene, path).close()
    with pytest.raises(ValueError, match="views differ"):
        open_session(scene, path, names=["a", "b", "c", "d", "e"])
    moved = scene.base_from_tool.copy()
    moved[0, 0, 3] += 0.01
    with pytest.raises(ValueError, match="base_from_tool differ"):
        ModelSession(scene.calibration, moved, scene.pictures, path=path)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match=r"exists without its journal other\.json\.journal"):
        open_session(scene, tmp_path / "other.json")
