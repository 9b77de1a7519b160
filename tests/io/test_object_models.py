import dataclasses
import json

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from scipy.spatial.transform import Rotation
from shared_data import shared_data
from solids import box

from smartview_jax.argument_checks import name_problem
from smartview_jax.io import load_object_model, object_model_to_dict, save_object_model
from smartview_jax.modeling import (
    Face,
    ObjectModel,
    edges_of_faces,
    find_symmetry,
    grasp_on_face,
    open_edges,
)


def full_model(seed=0):
    rng = np.random.default_rng(seed)
    model = box()
    root = rng.normal(size=(8, 3, 3)) * 1e-4
    faces = tuple(
        dataclasses.replace(face, graspable=k % 2 == 0) for k, face in enumerate(model.faces)
    )
    return dataclasses.replace(
        model,
        faces=faces,
        covariance=root @ root.swapaxes(1, 2),
        calibration_factor=rng.normal(size=(24, 5)) * 1e-4,
        grasps=(grasp_on_face(model, 1, name="from above"),),
        symmetry=dataclasses.replace(find_symmetry(model), confirmed=True),
        name='a "box" [40 mm]',
        provenance=("drawn by hand",),
        tolerance=4e-4,
    )


def assert_same(model, other):
    np.testing.assert_array_equal(model.vertices, other.vertices)
    np.testing.assert_array_equal(model.edges, other.edges)
    assert model.faces == other.faces
    assert (model.name, model.provenance) == (other.name, other.provenance)
    assert model.tolerance == pytest.approx(other.tolerance, rel=1e-12)
    np.testing.assert_allclose(model.vertex_covariances, other.vertex_covariances, rtol=1e-12)
    assert len(model.grasps) == len(other.grasps)
    for a, b in zip(model.grasps, other.grasps, strict=True):
        assert (a.name, a.face, a.opening, a.depth, a.tolerance) == (
            b.name,
            b.face,
            b.opening,
            b.depth,
            b.tolerance,
        )
        np.testing.assert_allclose(a.object_from_tool, b.object_from_tool, atol=1e-12)


@pytest.mark.parametrize("full", [False, True])
def test_what_is_saved_is_loaded(tmp_path, full):
    model = full_model()
    if full:
        root = np.random.default_rng(1).normal(size=(24, 24)) * 1e-5
        model = dataclasses.replace(model, covariance=root @ root.T)
    save_object_model(model, tmp_path / "box.json")
    loaded = load_object_model(tmp_path / "box.json")
    assert_same(model, loaded)
    assert loaded.symmetry.confirmed
    np.testing.assert_allclose(loaded.symmetry.rotations, model.symmetry.rotations, atol=1e-12)
    text = (tmp_path / "box.json").read_text()
    # A person reads one vertex or one face's loop in a line.
    assert "  [0.06, 0.04, 0.03]\n" in text
    assert '"loop": [0, 2, 3, 1]' in text
    assert 'a \\"box\\" [40 mm]' in text
    assert list(tmp_path.iterdir()) == [tmp_path / "box.json"]


coordinates = st.floats(-5.0, 5.0, allow_subnormal=False)


@given(
    hnp.arrays(float, st.tuples(st.integers(0, 12), st.just(3)), elements=coordinates),
    st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "S"]), max_size=30).filter(
        lambda name: name == "" or name_problem(name) is None
    ),
    st.data(),
)
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_wireframe_comes_back_to_the_last_digit(tmp_path, vertices, name, data):
    count = len(vertices)
    pairs = st.tuples(st.integers(0, count - 1), st.integers(0, count - 1))
    edges = data.draw(st.lists(pairs, max_size=10)) if count > 1 else []
    unique = sorted({(min(e), max(e)) for e in edges if e[0] != e[1]})
    model = ObjectModel(vertices, np.array(unique, int).reshape(-1, 2), name=name)
    save_object_model(model, tmp_path / "any.json")
    assert_same(model, load_object_model(tmp_path / "any.json"))


def test_millimetres_are_converted_at_the_edge(tmp_path):
    model = full_model()
    content = object_model_to_dict(model)
    content["unit"] = "mm"
    content["tolerance"] *= 1e3
    content["vertices"] = (1e3 * model.vertices).tolist()
    content["covariance"] = {
        "per_vertex": (1e6 * np.array(content["covariance"]["per_vertex"])).tolist()
    }
    content["calibration_factor"] = (1e3 * model.calibration_factor).tolist()
    content["symmetry"]["centre"] = (1e3 * model.symmetry.centre).tolist()
    grasp = content["grasps"][0]
    pose = grasp["object_from_tool"]
    pose["translation"] = [1e3 * x for x in pose["translation"]]
    for key in ("opening", "depth", "tolerance"):
        grasp[key] *= 1e3
    (tmp_path / "mm.json").write_text(json.dumps(content))
    loaded = load_object_model(tmp_path / "mm.json")
    assert loaded.tolerance == pytest.approx(model.tolerance, rel=1e-12)
    np.testing.assert_allclose(loaded.vertices, model.vertices, rtol=1e-12)
    np.testing.assert_allclose(loaded.vertex_covariances, model.vertex_covariances, rtol=1e-9)
    np.testing.assert_allclose(
        loaded.grasps[0].object_from_tool, model.grasps[0].object_from_tool, atol=1e-12
    )
    assert loaded.grasps[0].opening == pytest.approx(model.grasps[0].opening)
    np.testing.assert_allclose(loaded.symmetry.centre, model.symmetry.centre)


def change(*path_and_value):
    *path, last, value = path_and_value

    def apply(content):
        part = content
        for step in path:
            part = part[step]
        part[last] = value

    return apply


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (change("vertexes", []), "no entry is called 'vertexes'; did you mean 'vertices'"),
        (change("faces", 1, "grasable", True), "faces.1: no entry is called 'grasable'; did you"),
        (change("unit", "inch"), "unit is one of m, cm, mm; found 'inch'"),
        (change("vertices", 3, [0.0, 1.0]), "vertices.3: expected x, y, z: 3 numbers"),
        (change("vertices", 3, 1, "0.1"), "vertices.3.1: expected a number from"),
        (change("edges", 2, [0, 77]), "edge 2 .* leads to vertex 77, which does not exist"),
        (change("edges", 2, [0, 1, 2]), "edges.2: expected two vertices"),
        (change("faces", 0, "loop", [0, 1]), "faces.0.loop: expected 3 or more vertices"),
        (change("faces", 1, "loop", [4, 7, 5, 6]), r"face 1 \(top\): it crosses itself"),
        (change("vertices", 5, 2, 0.06), r"face \d \(.*\): it is not planar: vertex"),
        (change("grasps", 0, "face", 9), "grasp 'from above' is on face 9"),
        (change("covariance", {}), "covariance: expected either per_vertex or full"),
        (change("covariance", {"full": [[1.0, 2.0], [1.0]]}), "rows have different lengths"),
        (change("calibration_factor", [[0.1]]), "calibration_factor: expected 24"),
        (change("symmetry", "rotations", 0, [0.5, 0.0, 0.0, 0.0]), "unit quaternions"),
        (change("smartview_object", 2), "smartview_object: expected 1, found 2"),
        (lambda content: content.pop("end"), "truncated file"),
        (lambda content: content.pop("smartview_object"), "not an object model"),
        (lambda content: content.pop("vertices"), "entry 'vertices' is missing"),
    ],
)
def test_a_wrong_file_is_named_with_its_entry(tmp_path, edit, said):
    content = json.loads(json.dumps(object_model_to_dict(full_model())))
    edit(content)
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=said) as caught:
        load_object_model(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": 1,\n "b": }', "line 2, column 7"),
        ('{"unit": "m", "unit": "mm"}', "key 'unit' comes twice"),
        ('{"a": NaN}', "NaN is not a number"),
        ("[" * 100_000, "nested too deeply"),
        ("[1, 2]", "expected a mapping"),
        ("", "line 1"),
    ],
)
def test_what_is_not_json_is_named_with_its_line(tmp_path, text, said):
    path = tmp_path / "broken.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        load_object_model(path)
    with pytest.raises(FileNotFoundError):
        load_object_model(tmp_path / "missing.json")


@pytest.mark.parametrize(("name", "content"), [("part.stl", b"\x00\x80"), ("PART.OBJ", b"v 0 0 0")])
def test_a_mesh_in_the_place_of_a_model_is_told_the_way(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{name}: .* sv\.io\.read_mesh"):
        load_object_model(tmp_path / name)


@pytest.mark.parametrize("name", ["visp_castle_simu", "visp_cube"])
def test_real_cad_is_taken_saved_and_loaded(tmp_path, name):
    cad = json.loads((shared_data(name) / "object.json").read_text())
    faces = tuple(Face(tuple(loop)) for loop in cad.get("faces", []))
    model = ObjectModel(np.array(cad["vertices"]), np.array(cad["edges"]), faces, name=name)
    save_object_model(model, tmp_path / "model.json")
    assert_same(model, load_object_model(tmp_path / "model.json"))
    if name == "visp_cube":
        assert not open_edges(model.faces)
        assert find_symmetry(model).order == len(Rotation.create_group("O"))
        assert len(edges_of_faces(model.faces)) == len(model.edges) == 12
        for k in range(6):
            middle = model.vertices.mean(axis=0)
            assert model.plane(k).normal @ (model.plane(k).origin - middle) == pytest.approx(0.042)
