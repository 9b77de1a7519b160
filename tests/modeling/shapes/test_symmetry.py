import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solids import box, drilled, prism

from smartview_jax.modeling import (
    Face,
    ObjectModel,
    edges_of_faces,
    find_symmetry,
    shape_sigma,
)


def distances_between(one, other):
    return np.linalg.norm(one[:, None] - other[None], axis=-1)


@pytest.mark.parametrize(
    ("model", "group"),
    [
        (box(), Rotation.create_group("D2")),
        (box(0.04, 0.04, 0.03), Rotation.create_group("D4")),
        (box(0.03, 0.03, 0.03), Rotation.create_group("O")),
        (prism(5), Rotation.create_group("D5")),
    ],
    ids=["box", "square box", "cube", "prism"],
)
def test_groups_are_those_of_the_books(model, group):
    """Their orders and turning angles, as SciPy lists them."""
    symmetry = find_symmetry(model)
    assert symmetry.order == len(group)
    assert not symmetry.confirmed
    np.testing.assert_allclose(symmetry.rotations[0], np.eye(3))
    angles = np.sort(Rotation.from_matrix(symmetry.rotations).magnitude())
    np.testing.assert_allclose(angles, np.sort(group.magnitude()), atol=1e-6)
    for transform in symmetry.object_from_object:
        moved = model.vertices @ transform[:3, :3].T + transform[:3, 3]
        assert distances_between(moved, model.vertices).min(axis=1).max() < 1e-9


def test_a_cylinder_has_an_axis_and_a_box_has_none():
    axis = find_symmetry(prism(24)).axis
    np.testing.assert_allclose(np.abs(axis), [0, 0, 1], atol=1e-9)
    assert find_symmetry(prism(8)).axis is None


@pytest.mark.parametrize("hole", [30, 32, 41])
def test_a_nut_has_the_symmetry_of_the_solid_not_of_its_triangles(hole):
    """As Schoenflies lists it, D6, for any number of sides of the hole."""
    nut = drilled(6, hole)
    symmetry = find_symmetry(nut)
    assert symmetry.order == len(Rotation.create_group("D6")) == 12
    assert symmetry.axis is None
    np.testing.assert_allclose(symmetry.centre, [0.0, 0.0, 0.004], atol=1e-12)
    # A hole that is 0.1 mm off is no part of it; a tenth of a corner's tolerance is.
    for distance, order in ((1e-4, 2), (1e-6, 12)):
        moved = nut.vertices.copy()
        moved[12:, 0] += distance
        assert find_symmetry(dataclasses.replace(nut, vertices=moved)).order == order


def test_a_washer_is_round_whatever_its_rims_have_in_common():
    symmetry = find_symmetry(drilled(40, 27))
    np.testing.assert_allclose(np.abs(symmetry.axis), [0, 0, 1], atol=1e-9)
    # Turned over, too.
    assert symmetry.order == 80


def test_what_breaks_a_symmetry_is_seen():
    cube = box(0.03, 0.03, 0.03)
    # A diagonal on one face, and a missing face: both leave only the identity or a half turn.
    marked = dataclasses.replace(cube, edges=np.concatenate([cube.edges, [[4, 7]]]))
    assert find_symmetry(marked).order == 2
    assert find_symmetry(dataclasses.replace(cube, faces=cube.faces[1:])).order == 4
    bent = dataclasses.replace(cube, faces=(), vertices=cube.vertices + [[0.001, 0, 0]] + 0.0)
    moved = bent.vertices.copy()
    moved[7] += 0.002
    assert find_symmetry(dataclasses.replace(bent, vertices=moved)).order == 3
    # Within a stated tolerance, as of a model made from pictures, it is a cube again.
    assert find_symmetry(dataclasses.replace(bent, vertices=moved), 0.004).order == 24


def test_chirality_counts():
    """A mirrored half is no symmetry: only rotations are."""
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]]) * 0.01
    faces = tuple(map(Face, [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]))
    assert find_symmetry(ObjectModel(vertices, edges_of_faces(faces), faces)).order == 1


def test_points_on_one_line_have_no_finite_group():
    with pytest.raises(ValueError, match="one line"):
        find_symmetry(ObjectModel(np.outer(np.arange(4.0), [0.01, 0.02, 0.0])))


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (box(0.04, 0.04, 0.03), "4-fold about (0, 0, 1); 2-fold about 4 axes"),
        (box(0.03, 0.03, 0.03), "4-fold about 3 axes; 3-fold about 4 axes; 2-fold about 6 axes"),
        (prism(24), "round about (0, 0, 1)"),
        (dataclasses.replace(box(), edges=np.array([[4, 7]]), faces=()), "2-fold about (0, 0, 1)"),
    ],
)
def test_a_symmetry_is_told_in_words(model, words):
    assert find_symmetry(model).words.startswith(words)


def test_axes_count_the_turns_about_them():
    symmetry = find_symmetry(box(0.04, 0.04, 0.03))
    assert [axis.fold for axis in symmetry.axes] == [4, 2, 2, 2, 2]
    np.testing.assert_allclose(symmetry.axes[0].direction, [0, 0, 1], atol=1e-12)
    # Every turn but the identity is about one of them: sum of fold - 1.
    assert sum(axis.fold - 1 for axis in symmetry.axes) == symmetry.order - 1
    odd = ObjectModel(np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]]))
    assert find_symmetry(odd).words == "no turn maps it onto itself"


@pytest.mark.parametrize("tolerance", [0.0, 0.3e-3])
def test_a_model_is_as_inexact_as_it_is_far_from_its_symmetry(tolerance):
    """Vertices of a cube scattered by NumPy, and the cube's own symmetry."""
    exact, rng, squares = box(0.03, 0.03, 0.03), np.random.default_rng(3), []
    symmetry = find_symmetry(exact)
    for _ in range(200):
        scattered = exact.vertices + rng.normal(0.0, 0.2e-3, exact.vertices.shape)
        model = ObjectModel(scattered, exact.edges, tolerance=tolerance)
        model = dataclasses.replace(model, symmetry=symmetry)
        squares.append(shape_sigma(model) ** 2)
    assert np.sqrt(np.mean(squares)) == pytest.approx(np.hypot(0.2e-3, tolerance), rel=0.03)


def test_sides_of_a_hole_that_do_not_meet_make_no_model_inexact():
    nut = drilled(6, 41)
    nut = dataclasses.replace(nut, symmetry=find_symmetry(nut))
    assert shape_sigma(nut) < 1e-9
    # A measured model has the errors of its vertices in its covariance.
    scattered = nut.vertices + np.random.default_rng(0).normal(0.0, 1e-5, nut.vertices.shape)
    measured = dataclasses.replace(
        nut, vertices=scattered, covariance=np.tile(np.eye(3), (94, 1, 1))
    )
    assert shape_sigma(dataclasses.replace(measured, covariance=None)) > 1e-6
    assert shape_sigma(measured) == 0.0


def test_a_vertex_inside_a_face_makes_no_model_inexact():
    """A mesh may divide a flat side in any way; no turn has to map the parts onto each other."""
    cube = box(0.03, 0.03, 0.03)
    top = next(face for face in cube.faces if face.name == "top")
    parts = [Face((*side, len(cube.vertices))) for side in top.directed_edges]
    faces = (*(face for face in cube.faces if face is not top), *parts)
    vertices = np.vstack([cube.vertices, [0.01, 0.008, 0.03]])
    divided = ObjectModel(vertices, cube.edges, faces, symmetry=find_symmetry(cube))
    assert shape_sigma(divided) < 1e-9
