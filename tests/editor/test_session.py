import cv2
import numpy as np
import pytest
from polylines import nearest_on
from sessions import click_all

from smartview_jax.editor import ModelSession
from smartview_jax.editor.document import Document, apply_change
from smartview_jax.editor.entries import point_entry
from smartview_jax.io import load_object_model
from smartview_jax.modeling import open_edges


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
    assert not open_edges(model.faces)
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


def test_a_click_on_another_corner_is_named_with_its_view(session, scene):
    point = session.click("v1", scene.click(0, 3))
    for view, name in enumerate(session.names[1:4], start=1):
        session.click(name, scene.click(view, 3), point)
    assert (
        point_entry(session.document.points[point], session.estimates()[point]).get("wrong") is None
    )
    u, v = scene.click(2, 3)
    session.click("v3", (u + 6.0, v - 4.0), point)
    entry = point_entry(session.document.points[point], session.estimates()[point])
    assert list(entry["wrong"]) == ["v3"]
    distance = float(entry["wrong"]["v3"].split(" px from where the other views see")[0])
    # To where the other views see it; its own residual is smaller, since it draws the point.
    assert distance == pytest.approx(np.hypot(6.0, 4.0), abs=0.1)
    assert np.hypot(*entry["residuals"]["v3"]) < 0.9 * distance


def test_a_curve_passes_the_feature_at_its_depth(session, scene):
    curves = session.curves("v1", scene.click(0, 3))
    assert set(curves) == {"v2", "v3", "v4", "v5"}
    depth = np.linalg.norm(scene.truth.vertices[3] - session.geometry.centres[0])
    for k, name in enumerate(session.names[1:], start=1):
        distance, actual = nearest_on(curves[name], scene.pixels[k, 3])
        assert distance < 0.05
        assert actual == pytest.approx(depth, rel=1e-3)


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
        (lambda: session.click("v9", (1.0, 1.0)), "no view 'v9'; the views are v1"),
        (lambda: session.click("v1", (700.0, 1.0)), r"view v1: the click \(700, 1\) is outside"),
        (lambda: session.click("v1", (np.nan, 1.0)), "outside"),
        (lambda: session.click("v1", (1.0, 1.0), 999), "no point 999"),
        (lambda: session.add_edge(ids[0], ids[0]), "joins two different points"),
        (lambda: session.add_edge(ids[0], 999), "no point 999"),
        (lambda: session.add_face([ids[0], ids[1]]), "3 or more"),
        (lambda: session.add_face([ids[0], ids[1], lone]), f"point {lone} has no position"),
        (
            lambda: session.add_face([ids[0], ids[1], ids[2], ids[8]]),
            f"not planar: vertex ({ids[0]}|{ids[1]}|{ids[2]}|{ids[8]}) is",
        ),
        (lambda: session.add_face([ids[5], ids[7], ids[8], ids[6]]), "crosses itself"),
        (lambda: session.change({"do": "fly"}), "expected one of the changes"),
        (
            lambda: session.change({"do": "rename", "nam": "x"}),
            "rename: missing a required argument|unexpected",
        ),
        (lambda: session.add_grasp(0), "no face 0"),
        (lambda: session.delete("walls", 1), "kind is one of points, edges"),
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
    with pytest.raises(
        ValueError, match="no point has a position yet; click each point in two views"
    ):
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


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pictures": 1}, "at least 2 views; found 1"),
        ({"poses": "missing"}, "poses: expected one for each of 5 views, found 3"),
        ({"poses": "sheared"}, "view v2: not a rotation"),
        ({"picture": np.zeros((48, 64), np.uint8)}, "view v3: the picture has 64 x 48 px"),
        ({"picture": np.zeros((480, 640))}, "view v3: expected uint8"),
        ({"names": ["a", "b", "a", "c", "d"]}, "names: a given more than once"),
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
    actual = ModelSession(scene.calibration, scene.base_from_tool, files)
    np.testing.assert_array_equal(actual.pictures["v3"], scene.pictures[2])
    files[1].unlink()
    with pytest.raises(FileNotFoundError, match=r"1\.png"):
        ModelSession(scene.calibration, scene.base_from_tool, files)
    files[1].write_text("no picture")
    with pytest.raises(ValueError, match=r"view v2: .*1.png"):
        ModelSession(scene.calibration, scene.base_from_tool, files)


def test_clicks_snap_to_what_is_found(session, scene):
    corners = session.features("v1").corners
    near = np.linalg.norm(corners[:, None] - scene.pixels[0][None], axis=-1).min(axis=0)
    # The floor's far corners are hidden; the corners of roof and near wall are seen.
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
