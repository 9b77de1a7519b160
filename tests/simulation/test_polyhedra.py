import numpy as np
import pytest

from smartview_jax.simulation.polyhedra import (
    box,
    face_normal,
    random_polyhedron,
    roofed_block,
    stepped_block,
)

trimesh = pytest.importorskip("trimesh")

SOLIDS = {
    "box": (box(0.03, 0.02, 0.01), 8, 6e-6),
    # Area of the profile times its depth, by hand: 0.35 * 0.4 + 0.25 * 1.0 + 0.5 * 0.1 * 0.35.
    "stepped": (stepped_block(0.02), 12, 0.02**3 * 0.7 * (0.4 * 0.35 + 0.25 + 0.0175)),
    "roofed": (roofed_block(0.02), 10, 0.02**3 * (0.8 * 0.35 + 0.5 * 0.8 * 0.3)),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_fixed_solids_are_closed_and_have_the_volume_worked_out_by_hand(name):
    solid, vertex_count, volume = SOLIDS[name]
    mesh = trimesh.Trimesh(solid.vertices, solid.triangles, process=False)
    assert mesh.is_volume
    assert mesh.volume == pytest.approx(volume)
    assert len(solid.vertices) == vertex_count
    # Euler's formula for a solid without holes.
    assert len(solid.vertices) - len(solid.edges) + len(solid.faces) == 2
    assert solid.vertices[:, 2].min() == 0.0


@pytest.mark.parametrize("vertex_count", [8, 14, 24])
def test_random_solids_are_convex_and_of_the_size_asked_for(vertex_count):
    solid = random_polyhedron(np.random.default_rng(vertex_count), vertex_count)
    mesh = trimesh.Trimesh(solid.vertices, solid.triangles, process=False)
    assert mesh.is_volume
    assert mesh.is_convex
    assert len(solid.vertices) == vertex_count
    assert len(solid.vertices) - len(solid.edges) + len(solid.faces) == 2
    for face in solid.faces:
        loop = solid.vertices[list(face)] - solid.vertices[face[0]]
        assert np.abs(loop @ face_normal(solid.vertices, face)).max() < 1e-10


def test_a_random_solid_is_the_same_for_the_same_seed():
    first, second = (random_polyhedron(np.random.default_rng(5), 10) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)


@pytest.mark.parametrize("vertex_count", [6, 9])
def test_impossible_vertex_counts_are_refused(vertex_count):
    with pytest.raises(ValueError, match=f"even number from 8, found {vertex_count}"):
        random_polyhedron(np.random.default_rng(0), vertex_count)


def test_a_moved_solid_keeps_its_faces():
    matrix = trimesh.transformations.rotation_matrix(0.3, [1.0, 2.0, 0.5], [0.1, 0.0, 0.0])
    solid = stepped_block()
    expected = trimesh.transform_points(solid.vertices, matrix)
    moved = solid.moved(matrix)
    np.testing.assert_allclose(moved.vertices, expected, atol=1e-15)
    assert moved.faces == solid.faces
