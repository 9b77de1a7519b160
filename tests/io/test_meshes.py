import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from shared_data import shared_data
from solids import box, moved, prism

from smartview_jax.io import model_from_triangles, read_mesh, to_trimesh, write_mesh
from smartview_jax.io.meshes import MESH_FORMATS
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces, open_edges, signed_volume

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("mapbox_earcut")


def sorted_points(points):
    rounded = np.round(points, 7) + 0.0
    return rounded[np.lexsort(rounded.T)]


def frame_solid():
    """A square frame: its top and bottom have a hole each, and it has walls inside and out."""
    outer = np.array([[0, 0], [6, 0], [6, 6], [0, 6]]) * 0.01
    inner = np.array([[2, 2], [4, 2], [4, 4], [2, 4]]) * 0.01
    rings = [(outer, 0.0), (outer, 0.02), (inner, 0.0), (inner, 0.02)]
    vertices = np.concatenate([np.column_stack([ring, np.full(4, h)]) for ring, h in rings])
    walls = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
    inside = [(8 + k, 12 + k, 12 + (k + 1) % 4, 8 + (k + 1) % 4) for k in range(4)]
    ends = [Face((3, 2, 1, 0), ((8, 9, 10, 11),)), Face((4, 5, 6, 7), ((15, 14, 13, 12),))]
    faces = (*map(Face, walls + inside), *ends)
    return ObjectModel(vertices, edges_of_faces(faces), faces)


@pytest.mark.parametrize("kind", MESH_FORMATS)
@pytest.mark.parametrize("model", [box(), prism(7), frame_solid()], ids=["box", "prism", "frame"])
def test_flat_faces_and_edges_come_back_from_triangles(tmp_path, kind, model):
    path = write_mesh(model, tmp_path / f"solid.{kind}")
    loaded = read_mesh(path)
    np.testing.assert_allclose(
        sorted_points(loaded.vertices), sorted_points(model.vertices), atol=2e-8
    )
    assert len(loaded.edges) == len(model.edges)
    assert sorted(len(f.loops) for f in loaded.faces) == sorted(len(f.loops) for f in model.faces)
    assert not open_edges(loaded.faces)
    assert signed_volume(loaded.vertices, loaded.faces) == pytest.approx(
        signed_volume(model.vertices, model.faces), rel=1e-5
    )


@given(st.integers(3, 9), st.floats(0.01, 0.2), st.integers(0, 2**32 - 1))
@settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_any_prism_in_any_pose_comes_back(tmp_path, sides, height, seed):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    pose[:3, 3] = [0.3, -0.2, 0.5]
    model = moved(prism(sides, height=height), pose)
    loaded = read_mesh(write_mesh(model, tmp_path / "prism.ply"))
    assert (len(loaded.vertices), len(loaded.faces)) == (2 * sides, sides + 2)
    assert len(loaded.edges) == 3 * sides
    mesh = to_trimesh(loaded)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(signed_volume(model.vertices, model.faces), rel=1e-5)


def test_what_other_programs_cut_finely_is_joined():
    """A subdivided box of trimesh has many triangles in a face and vertices along its edges."""
    mesh = trimesh.creation.box((0.06, 0.04, 0.03)).subdivide().subdivide()
    model = model_from_triangles(np.array(mesh.vertices), np.array(mesh.faces))
    assert (len(model.vertices), len(model.edges), len(model.faces)) == (8, 12, 6)
    assert model.symmetry.order == len(Rotation.create_group("D2"))
    assert not open_edges(model.faces)


def test_the_round_part_of_a_cylinder_is_no_edge():
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.05, sections=48)
    model = model_from_triangles(np.array(mesh.vertices), np.array(mesh.faces))
    # The wireframe is the two rims; the steps of 7.5 degrees between the walls are none.
    assert len(model.edges) == 2 * 48
    heights = model.vertices[model.edges][..., 2]
    np.testing.assert_allclose(heights[:, 0], heights[:, 1], atol=1e-12)
    every = model_from_triangles(
        np.array(mesh.vertices), np.array(mesh.faces), sharp_angle=np.deg2rad(5.0)
    )
    assert len(every.edges) == 3 * 48


def test_millimetres_are_said_not_guessed(tmp_path):
    mesh = trimesh.creation.box((60.0, 40.0, 30.0))
    path = tmp_path / "# cad.stl"
    mesh.export(path)
    # A file may be called what an object may not.
    assert read_mesh(path, unit="mm").name == "cad"
    assert np.ptp(read_mesh(path, unit="mm").vertices, axis=0) == pytest.approx([0.06, 0.04, 0.03])
    mesh.apply_scale(10.0)
    mesh.export(path)
    with pytest.raises(ValueError, match=r"cad.stl: .*expected metres"):
        read_mesh(path)


def test_what_is_not_a_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="only a wireframe, no faces"):
        write_mesh(ObjectModel(np.eye(3), np.array([[0, 1]])), tmp_path / "wire.obj")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match=r"expected a name ending in \.obj"):
        write_mesh(box(), tmp_path / "box.step")
    with pytest.raises(FileNotFoundError):
        read_mesh(tmp_path / "missing.obj")
    for kind in MESH_FORMATS:
        path = tmp_path / f"broken.{kind}"
        path.write_text("this is no mesh")
        with pytest.raises(ValueError, match=f"broken.{kind}: "):
            read_mesh(path)
    with pytest.raises(ValueError, match="unit is one of m, cm, mm"):
        read_mesh(path, unit="inch")


@pytest.mark.parametrize("kind", ["obj", "stl", "glb"])
def test_the_real_cubes_cad_comes_back(tmp_path, kind):
    cad = json.loads((shared_data("visp_cube") / "object.json").read_text())
    faces = tuple(Face(tuple(loop)) for loop in cad["faces"])
    model = ObjectModel(np.array(cad["vertices"]), np.array(cad["edges"]), faces)
    loaded = read_mesh(write_mesh(model, tmp_path / f"cube.{kind}"))
    assert (len(loaded.vertices), len(loaded.edges), len(loaded.faces)) == (8, 12, 6)
    assert signed_volume(loaded.vertices, loaded.faces) == pytest.approx(0.084**3, rel=1e-5)


@pytest.mark.parametrize("index", [-1, 8, 10**6])
def test_a_triangle_of_a_vertex_that_does_not_exist_is_named(index):
    solid = to_trimesh(box())
    triangles = np.array(solid.faces)
    triangles[3, 1] = index
    with pytest.raises(ValueError, match=rf"a triangle has the vertices .*{index}.* has 8"):
        model_from_triangles(np.array(solid.vertices), triangles)


def test_a_vertex_that_is_broken_by_a_blank_is_named(tmp_path):
    """A fourth number of a vertex is legal, and its point would be another one."""
    path = write_mesh(box(), tmp_path / "box.obj")
    text = path.read_text()
    assert text.count("v 0.06") > 1
    path.write_text(text.replace("v 0.06", "v 0.0 6", 1))
    with pytest.raises(ValueError, match=r"box\.obj: vertices of 3, 4 numbers"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("element vertex 8", "element vertex 7", "20 rows, but its header says 19"),
        ("element face 12", "element face 9", "20 rows, but its header says 17"),
        ("0.06", "0.0 6", "the row '.*0.0 6.*' has not the numbers"),
        ("\n3 ", "\n4 ", "the row '4 .*' has not the numbers"),
    ],
)
def test_rows_of_a_ply_are_those_of_its_header(tmp_path, old, new, message):
    """Fewer triangles, or another vertex, would be read without a word."""
    path = tmp_path / "box.ply"
    path.write_bytes(to_trimesh(box()).export(file_type="ply", encoding="ascii"))
    assert len(read_mesh(path).faces) == 6
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=rf"box\.ply: {message}"):
        read_mesh(path)
