import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from editor_scene import drawn_scene

from smartview_jax.editor import ModelSession
from smartview_jax.editor.document import Document, apply_change
from smartview_jax.editor.entries import edge_entries
from smartview_jax.io import load_object_model
from smartview_jax.modeling import KnownLength, SamePlane, dimension


@pytest.fixture(scope="module")
def scene():
    return drawn_scene()


@pytest.fixture
def session(scene, tmp_path):
    with open_session(scene, tmp_path / "house.json") as opened:
        yield opened


def open_session(scene, path=None, **given):
    return ModelSession(scene.calibration, scene.base_from_tool, scene.pictures, path=path, **given)


def click_all(session, scene, views=(0, 1, 3), seed=0):
    """Click every vertex in some views; return the ids."""
    rng = np.random.default_rng(seed)
    ids = []
    for vertex in range(len(scene.truth.vertices)):
        point = None
        for view in views:
            pixel = scene.click(view, vertex, rng)
            point = session.click(session.names[view], pixel, point)
        ids.append(point)
    return ids


def test_a_whole_model_is_made_by_clicks(session, scene, tmp_path):
    ids = click_all(session, scene)
    faces = [session.add_face([ids[v] for v in face.loop]) for face in scene.truth.faces]
    session.change({"do": "change_face", "id": faces[2], "name": "floor", "graspable": False})
    session.change({"do": "rename", "name": "house"})
    session.save()
    assert session.is_saved
    model = load_object_model(tmp_path / "house.json")
    # 0.3 px at 0.2 m and 1024 px of focal length are 0.06 mm across; the truth is within 4 sigma.
    difference = model.vertices - scene.truth.vertices
    assert np.linalg.norm(difference, axis=1).max() < 8e-4
    squared = np.einsum(
        "vi,vij,vj->v", difference, np.linalg.inv(model.vertex_covariances), difference
    )
    assert squared.max() < 25.0
    assert model.is_closed
    assert len(model.edges) == len(scene.truth.edges) == 15
    assert model.faces[2].name == "floor"
    for k, face in enumerate(model.faces):
        assert set(face.loop) == set(scene.truth.faces[k].loop)
        assert model.plane(k).normal @ scene.truth.plane(k).normal > 0.99
    length, sigma = session.distance(ids[0], ids[5])
    assert abs(length - 0.05) < 4.0 * sigma < 1e-3


def test_two_clicks_make_a_point_with_ellipse_and_residual(session, scene):
    point = session.click("v1", scene.click(0, 3))
    assert "v1 only" in session.problems()["points", point]
    session.click("v2", scene.click(1, 3), point)
    estimate = session.estimates()[point]
    np.testing.assert_allclose(estimate.position, scene.truth.vertices[3], atol=1e-7)
    np.testing.assert_allclose(estimate.predicted, scene.pixels[:, 3], atol=1e-4)
    assert set(estimate.residuals) == {"v1", "v2"}
    assert estimate.visible.all()
    # Where it was not clicked it is less certain, most of all along the curve.
    areas = np.sqrt(np.linalg.det(estimate.ellipses))
    assert areas[2:].min() > areas[:2].max()


def test_a_curve_passes_the_feature_at_its_depth(session, scene):
    curves = session.curves("v1", scene.click(0, 3))
    assert set(curves) == {"v2", "v3", "v4", "v5"}
    depth = np.linalg.norm(scene.truth.vertices[3] - session.geometry.centres[0])
    for k, name in enumerate(session.names[1:], start=1):
        distance, found = curves[name].nearest(scene.pixels[k, 3])
        assert distance < 0.05
        assert found == pytest.approx(depth, rel=1e-3)


def test_undo_and_redo_lead_to_the_same_documents(session, scene):
    states = [session.document]
    a = session.click("v1", scene.click(0, 0))
    states.append(session.document)
    session.click("v2", scene.click(1, 0), a)
    states.append(session.document)
    session.delete("points", a)
    states.append(session.document)
    for state in states[-2::-1]:
        assert session.undo()
        assert session.document == state
    assert not session.undo()
    for state in states[1:]:
        assert session.redo()
        assert session.document == state
    assert not session.redo()
    session.undo()
    session.click("v3", scene.click(2, 0), a)
    assert not session.can_redo


def test_what_is_wrong_is_said_and_changes_nothing(session, scene):
    ids = click_all(session, scene, views=(0, 1))
    lone = session.click("v1", (3.0, 4.0))
    before, lines = session.document, session._journal.path.read_bytes()
    wrong = [
        (lambda: session.click("v9", (1.0, 1.0)), "there is no view 'v9'; the views are v1"),
        (lambda: session.click("v1", (700.0, 1.0)), r"view v1: the click \(700, 1\) is outside"),
        (lambda: session.click("v1", (np.nan, 1.0)), "outside"),
        (lambda: session.click("v1", (1.0, 1.0), 999), "there is no point 999"),
        (lambda: session.add_edge(ids[0], ids[0]), "joins two points"),
        (lambda: session.add_edge(ids[0], 999), "there is no point 999"),
        (lambda: session.add_face([ids[0], ids[1]]), "3 or more"),
        (lambda: session.add_face([ids[0], ids[1], lone]), f"point {lone} has no position"),
        (lambda: session.add_face([ids[0], ids[1], ids[2], ids[8]]), "not planar: vertex"),
        (lambda: session.add_face([ids[5], ids[7], ids[8], ids[6]]), "crosses itself"),
        (lambda: session.change({"do": "fly"}), "expected one of the changes"),
        (
            lambda: session.change({"do": "rename", "nam": "x"}),
            "rename: missing a required argument|unexpected",
        ),
        (lambda: session.add_grasp(0), "there is no face 0"),
        (lambda: session.delete("walls", 1), "expected one of points, edges"),
    ]
    for call, said in wrong:
        with pytest.raises(ValueError, match=said):
            call()
    assert session.document is before
    assert session._journal.path.read_bytes() == lines


def test_a_point_of_one_view_has_no_distance_and_makes_no_file(session, scene):
    one, other = (session.click("v1", scene.click(0, vertex)) for vertex in (0, 3))
    with pytest.raises(ValueError, match=f"point {one} has no position: fewer than two views"):
        session.distance(one, other)
    with pytest.raises(ValueError, match="no point has a position yet; click each in two views"):
        session.save()
    assert not session.path.exists()
    # A view in which the person clicked nothing changes nothing.
    session.click("v3", scene.click(2, 0), one)
    assert set(session.estimates()[one].residuals) == {"v1", "v3"}


def test_a_blank_picture_is_named_and_can_still_be_clicked(scene):
    pictures = [*scene.pictures[:3], np.full_like(scene.pictures[3], 90), scene.pictures[4]]
    session = ModelSession(scene.calibration, scene.base_from_tool, pictures)
    said = "view v4: picture: blank, its grey levels are between 90 and 90"
    for ask in (lambda: session.features("v4"), session.propose):
        with pytest.raises(ValueError, match=said):
            ask()
    session.prepare()
    point = session.click("v4", scene.click(3, 3))
    session.click("v1", scene.click(0, 3), point)
    assert not session.estimates()[point].failure


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
    with pytest.raises(ValueError, match=r"journal: line 4: there is no point 7"):
        open_session(scene, path)


def test_a_grasp_stays_on_its_face(session, scene):
    ids = click_all(session, scene)
    faces = [session.add_face([ids[v] for v in face.loop]) for face in scene.truth.faces]
    # From the side: the gables are 50 mm apart.
    grasp = session.add_grasp(faces[1], depth=0.008, opening=0.06, name="gable")
    assert session.model().grasps[0].name == "gable"
    session.change_grasp(grasp, angle=0.3)
    made = session.model().grasps[0]
    normal = session.model().plane(1).normal
    np.testing.assert_allclose(made.approach, -normal, atol=1e-9)
    with pytest.raises(ValueError, match=r"grasp: .* wide there"):
        session.change_grasp(grasp, opening=0.001)
    session.delete("points", ids[5])
    assert session.model().grasps == ()
    session.undo()
    assert len(session.model().grasps) == 1


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
    for kept in range(1, len(last)):
        journal.write_bytes(whole[: len(whole) - kept])
        with open_session(scene, path) as again:
            assert again.document == expected
            assert kept == len(last) or "torn" in again.notes[0]
            again.click("v3", (50.0, 60.0), point)
        if kept in (1, len(last) - 1):
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
    ended = subprocess.Popen([sys.executable, "-c", "pass"])
    ended.wait()
    number = ended.pid if pid == "ended" else os.getpid()
    content = {"pid": number, "host": socket.gethostname(), "started": "0"}
    (tmp_path / "house.json.lock").write_text(json.dumps(content))
    open_session(scene, path).close()


def test_a_killed_process_loses_nothing(tmp_path):
    """SIGKILL in the middle of clicking; every click that was answered is there."""
    code = """
import sys; sys.path.insert(0, sys.argv[2])
from editor_scene import drawn_scene
from test_session import open_session
scene = drawn_scene()
session = open_session(scene, sys.argv[1])
for k in range(100000):
    session.click("v1", (k % 600, 20.0))
    print(k, flush=True)
"""
    folder = Path(__file__).parent
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "house.json"), str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
    )
    answered = [int(process.stdout.readline()) for _ in range(20)]
    process.send_signal(signal.SIGKILL)
    answered += [int(line) for line in process.stdout.read().split("\n") if line.strip()]
    process.wait()
    process.stdout.close()
    scene = drawn_scene()
    with open_session(scene, tmp_path / "house.json") as session:
        # One more may be on the disk that was not answered yet.
        assert len(session.document.points) - len(answered) in (0, 1)
        assert session.document.points[answered[-1]] == {"v1": (answered[-1] % 600, 20.0)}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pictures": 1}, "at least 2 views; found 1"),
        ({"poses": "missing"}, r"base_from_tool: expected shape \(5, 4, 4\)"),
        ({"poses": "sheared"}, "view v2: not a rotation"),
        ({"picture": np.zeros((48, 64), np.uint8)}, "view v3: the picture has 64 x 48 px"),
        ({"picture": np.zeros((480, 640))}, "view v3: expected uint8"),
        ({"names": ["a", "b", "a", "c", "d"]}, "view 'a' comes twice"),
        ({"names": ["a"]}, "expected a name for each of 5"),
    ],
)
def test_views_that_are_no_views_are_refused(scene, given, said):
    pictures, poses = list(scene.pictures), scene.base_from_tool.copy()
    if "pictures" in given:
        pictures, poses = pictures[:1], poses[:1]
    if given.get("poses") == "missing":
        poses = poses[:3]
    if given.get("poses") == "sheared":
        poses[1, 0, 0] += 0.1
    if "picture" in given:
        pictures[2] = given["picture"]
    with pytest.raises(ValueError, match=said):
        ModelSession(scene.calibration, poses, pictures, given.get("names"))


def test_pictures_are_read_from_files(scene, tmp_path):
    files = [tmp_path / f"{k}.png" for k in range(5)]
    for file, picture in zip(files, scene.pictures, strict=True):
        cv2.imwrite(str(file), picture)
    found = ModelSession(scene.calibration, scene.base_from_tool, files)
    np.testing.assert_array_equal(found.pictures["v3"], scene.pictures[2])
    files[1].unlink()
    with pytest.raises(FileNotFoundError, match=r"1\.png"):
        ModelSession(scene.calibration, scene.base_from_tool, files)
    files[1].write_text("no picture")
    with pytest.raises(ValueError, match=r"view v2: .*1.png"):
        ModelSession(scene.calibration, scene.base_from_tool, files)


def test_the_journal_of_other_views_is_refused(scene, tmp_path):
    path = tmp_path / "house.json"
    open_session(scene, path).close()
    with pytest.raises(ValueError, match="the journal's views are"):
        open_session(scene, path, names=["a", "b", "c", "d", "e"])
    moved = scene.base_from_tool.copy()
    moved[0, 0, 3] += 0.01
    with pytest.raises(ValueError, match="the journal's base_from_tool"):
        ModelSession(scene.calibration, moved, scene.pictures, path=path)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match=r"its journal other\.json\.journal does not"):
        open_session(scene, tmp_path / "other.json")


def test_clicks_snap_to_what_is_found(session, scene):
    corners = session.features("v1").corners
    near = np.linalg.norm(corners[:, None] - scene.pixels[0][None], axis=-1).min(axis=0)
    # The floor's far corners are hidden; those of the roof and the near wall are seen.
    assert (near < 2.5).sum() >= 6


def test_changes_do_not_touch_the_old_document():
    one = apply_change(Document(), {"do": "add_point", "clicks": {"v1": [1.0, 2.0]}})
    two = apply_change(one, {"do": "click", "point": 0, "view": "v2", "pixel": [3.0, 4.0]})
    assert one.points == {0: {"v1": (1.0, 2.0)}}
    three = apply_change(two, {"do": "remove_click", "point": 0, "view": "v1"})
    assert three.points == {0: {"v2": (3.0, 4.0)}}
    assert apply_change(three, {"do": "remove_click", "point": 0, "view": "v2"}).points == {}
    both = {"do": "several", "changes": [{"do": "add_point", "clicks": {}}] * 2}
    assert apply_change(one, both).next_id == 3


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
        ({"kind": "known_length", "items": [[0, 1]]}, "needs its length"),
        ({"kind": "known_length", "items": [[0, 1]], "value": -1.0}, "above 0 m"),
        ({"kind": "known_length", "items": [[0, 77]], "value": 1.0}, "no point 77"),
    ],
)
def test_a_fact_that_cannot_be_is_refused(session, scene, fact, said):
    click_all(session, scene, views=(0, 1))
    before = session.document
    with pytest.raises(ValueError, match=said):
        session.change({"do": "add_constraint", **fact})
    assert session.document is before


def drawn_house(session, scene):
    """All points and faces of the house."""
    ids = click_all(session, scene)
    for face in scene.truth.faces:
        session.add_face([ids[vertex] for vertex in face.loop])
    return ids


def test_a_symmetry_is_found_confirmed_and_saved(session, scene, tmp_path):
    assert session.symmetry() is None
    with pytest.raises(ValueError, match="fewer than three vertices"):
        session.confirm_symmetry()
    drawn_house(session, scene)
    # The house is the same after half a turn about the vertical through the middle of its ridge.
    found = session.symmetry()
    assert found.order == 2
    assert not found.confirmed
    (axis,) = found.axes
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
        ({"confirmed": "yes"}, "confirmed, refused or left open; found 'yes'"),
        ({"confirmed": True, "order": 0}, "1 turn or more; found 0"),
        ({}, "confirm_symmetry: missing"),
    ],
)
def test_what_cannot_be_said_of_a_symmetry_is_refused(session, change, said):
    with pytest.raises(ValueError, match=said):
        session.change({"do": "confirm_symmetry", **change})


def say(session, kind, *items, **given):
    change = {"do": "add_constraint", "kind": kind, "items": [list(group) for group in items]}
    session.change({**change, **given})


def test_the_deviation_of_a_length_is_that_of_both_points_together(session, scene, tmp_path):
    ids = click_all(session, scene, views=(0, 1))
    say(session, "known_length", (ids[0], ids[5]), value=0.05)
    say(session, "same_plane", [ids[v] for v in scene.truth.faces[2].loop])
    # Each of the two is uncertain, and their distance is not.
    estimates = session.estimates()
    assert np.sqrt(np.trace(estimates[ids[0]].covariance)) > 1e-4
    assert session.distance(ids[0], ids[5])[1] < 1e-7
    # All distances at once are those of the refinement's joint covariance.
    points = list(session.document.points.values())
    constraints = [
        KnownLength((0, 5), 0.05),
        SamePlane(tuple(scene.truth.faces[2].loop)),
    ]
    _, features = session.geometry.refined(points, constraints)
    pairs = [(0, 1), (0, 4), (1, 6), (5, 9)]
    for (a, b), found in zip(
        pairs, session.distances([(ids[a], ids[b]) for a, b in pairs]), strict=True
    ):
        np.testing.assert_allclose(found, dimension(features, a, b), rtol=1e-6)
    # So are those of the file, which keeps the correlations.
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
    for seed in range(40):
        session = open_session(scene, click_sigma=0.3)
        ids = click_all(session, scene, views=(0, 1), seed=seed)
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
    # Both lengths are one number: 40 squares, whose mean has a standard deviation of 0.22.
    assert 0.4 < np.mean(squares) < 1.8
    assert np.mean(apart) < 0.2
