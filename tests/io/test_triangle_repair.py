"""Faults of mesh files, made by hand in solids of trimesh."""

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.io import model_from_triangles, read_mesh
from smartview_jax.io.meshes import _flat_groups
from smartview_jax.io.triangle_repair import repaired_triangles
from smartview_jax.modeling import open_edges, signed_volume

trimesh = pytest.importorskip("trimesh")
BOX = trimesh.creation.box((0.06, 0.04, 0.03))
VERTICES, TRIANGLES = np.array(BOX.vertices), np.array(BOX.faces)


def volume(solid):
    """By trimesh, which repairs nothing here."""
    corners = (solid.vertices, solid.triangles)
    return trimesh.Trimesh(*corners, process=False).volume


def flipped(chosen):
    return np.where(np.asarray(chosen)[:, None], TRIANGLES[:, ::-1], TRIANGLES)


@pytest.mark.parametrize(
    ("triangles", "note"),
    [
        (TRIANGLES[:, ::-1], "12 of 12 triangles are turned over"),
        (flipped(np.arange(12) == 3), "1 of 12 triangles are turned over"),
        (flipped(np.arange(12) % 3 == 0), "4 of 12 triangles are turned over"),
        (
            np.concatenate([TRIANGLES, TRIANGLES[:2, [1, 2, 0]]]),
            "triangles that repeat others and are left out: 2",
        ),
        (np.concatenate([TRIANGLES, TRIANGLES[:, ::-1]]), "repeat others and are left out: 12"),
    ],
    ids=["inside out", "one turned", "some turned", "some twice", "both sides"],
)
def test_a_box_is_the_same_box_despite_its_file(triangles, note):
    model = model_from_triangles(VERTICES, triangles)
    assert (len(model.vertices), len(model.edges), len(model.faces)) == (8, 12, 6)
    assert not open_edges(model.faces)
    assert signed_volume(model.vertices, model.faces) == pytest.approx(BOX.volume)
    assert model.symmetry.order == len(Rotation.create_group("D2"))
    assert any(note in sentence for sentence in model.provenance)


@pytest.mark.parametrize("turned", [False, True])
def test_a_vertex_within_a_side_leaves_no_gap(turned):
    """A triangle without an area joins both halves of the side to the neighbour."""
    a, b, c = TRIANGLES[0]
    vertices = np.concatenate([VERTICES, 0.5 * (VERTICES[[a]] + VERTICES[[b]])])
    given = np.concatenate([TRIANGLES[1:], [[a, 8, c], [8, b, c], [a, b, 8]]])
    repaired = repaired_triangles(vertices, given[:, ::-1] if turned else given)
    assert volume(repaired) == pytest.approx(BOX.volume)
    said = "13 of 13 triangles are turned over, so that normals point outward"
    assert repaired.notes == ((said,) if turned else ())


def test_a_sound_file_is_not_remarked_upon():
    assert model_from_triangles(VERTICES, TRIANGLES).provenance == ()


def test_a_missing_triangle_is_said():
    (note,) = model_from_triangles(VERTICES, TRIANGLES[1:]).provenance
    assert note == "the surface is open: 3 sides of triangles have no neighbour"


def test_an_open_surface_keeps_the_side_of_most_triangles():
    given = flipped(np.arange(12) == 2)[2:]
    kept = repaired_triangles(VERTICES, given).triangles
    assert {frozenset(map(tuple, t[[[0, 1], [1, 2], [2, 0]]])) for t in kept} == {
        frozenset(map(tuple, t[[[0, 1], [1, 2], [2, 0]]])) for t in TRIANGLES[2:]
    }


@pytest.mark.parametrize("turned", [(False, False), (True, False), (False, True), (True, True)])
def test_a_cavity_is_empty_whichever_way_its_triangles_run(turned):
    shells = [trimesh.creation.icosphere(1, radius) for radius in (0.03, 0.02)]
    vertices = np.concatenate([shell.vertices for shell in shells])
    triangles = [
        (shell.faces[:, ::-1] if turn else shell.faces) + k * len(shells[0].vertices)
        for k, (shell, turn) in enumerate(zip(shells, turned, strict=True))
    ]
    repaired = repaired_triangles(vertices, np.concatenate(triangles))
    assert volume(repaired) == pytest.approx(shells[0].volume - shells[1].volume)


@pytest.mark.parametrize("shift", [(0.2, 0.0, 0.0), (0.06, 0.04, 0.0)], ids=["apart", "touching"])
def test_each_of_several_solids_is_outward(shift):
    """Also where they have an edge in common."""
    vertices = np.concatenate([VERTICES, VERTICES + np.array(shift)])
    repaired = repaired_triangles(vertices, np.concatenate([TRIANGLES, TRIANGLES[:, ::-1] + 8]))
    assert volume(repaired) == pytest.approx(2.0 * BOX.volume)


def test_single_precision_far_from_the_origin_separates_no_vertices():
    """A CAD program rounds the same corner of two triangles differently, by one digit."""
    corners = (VERTICES + np.array([3.0, -2.0, 1.0]))[TRIANGLES].reshape(-1, 3).astype(np.float32)
    corners[::2] = np.nextafter(corners[::2], np.float32(10.0))
    model = model_from_triangles(corners.astype(float), np.arange(36).reshape(-1, 3))
    assert (len(model.vertices), len(model.faces)) == (8, 6)


def test_the_middle_of_a_fine_disc_takes_little_memory():
    """In an STL it is as many vertices as the disc has triangles, and their pairs are millions."""
    count = 3000
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    rim = 0.02 * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    corners = np.stack([rim, np.roll(rim, -1, axis=0), 0.0 * rim], axis=1).reshape(-1, 3)
    tracemalloc.start()
    repaired = repaired_triangles(corners, np.arange(3 * count).reshape(-1, 3))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert repaired.notes == (f"the surface is open: {count} sides of triangles have no neighbour",)
    assert most < 20e6


def test_a_strip_of_one_side_is_read():
    """Moebius' strip cannot be turned so that all neighbours agree."""
    angles = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    across = np.column_stack(
        [
            np.cos(angles) * np.cos(angles / 2),
            np.sin(angles) * np.cos(angles / 2),
            np.sin(angles / 2),
        ]
    )
    middle = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    vertices = np.concatenate([middle + 0.3 * across, middle - 0.3 * across])
    following = np.append(np.arange(1, 30), 30)
    opposite = np.append(np.arange(31, 60), 0)
    k = np.arange(30)
    triangles = np.concatenate(
        [np.column_stack([k, following, k + 30]), np.column_stack([following, opposite, k + 30])]
    )
    assert len(repaired_triangles(vertices, triangles).triangles) == 60


def test_a_fine_cylinder_is_round_not_bent():
    """Each of 800 walls bends by less than what counts as flat: together they are no face."""
    mesh = trimesh.creation.cylinder(radius=0.02, height=0.05, sections=800)
    sound = repaired_triangles(np.array(mesh.vertices), np.array(mesh.faces))
    assert sound.notes == ()
    assert len(np.bincount(_flat_groups(mesh))) == 802


@pytest.mark.parametrize(
    ("unit", "scale", "message"),
    [
        ("m", 1e3, "an object of 60 m; expected metres"),
        ("mm", 1.0, "in mm the object is 0.06 mm large"),
    ],
)
def test_a_part_in_another_unit_is_refused(tmp_path, unit, scale, message):
    """Millimetres read as metres are a house, and metres read as millimetres a grain."""
    path = tmp_path / "part.stl"
    BOX.copy().apply_scale(scale).export(path)
    with pytest.raises(ValueError, match=rf"part\.stl: .*{message}"):
        read_mesh(path, unit=unit)
