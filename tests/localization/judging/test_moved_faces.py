"""Where a face is moved to, and what is found there, on drawn edges of solids of other sizes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import drawn, not_behind, together
from placed_box import MIDDLE, MODEL, POSE
from seen_scene import SAMPLES
from solids import box, prism

from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import EdgeLookup, Wireframe, evidence_of
from smartview_jax.localization.edges.edge_lines import EXPLAINED_DISTANCE
from smartview_jax.localization.edges.prediction import faces_before
from smartview_jax.localization.judging.moved_faces import (
    MOVED_SAMPLES,
    _found_lengths,
    _moved,
    _rates,
    face_places,
    likeliest_moved_face,
    movements_of_face,
)
from smartview_jax.localization.refining.refinement import measured_lines
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces

SIDES = np.ptp(MODEL.vertices, axis=0)
FAR = {0: "right", 1: "back", 2: "top"}
FACE_OF = {face.name: k for k, face in enumerate(MODEL.faces)}
BAR = box(0.012, 0.03, 0.08)


def frustum():
    """A truncated pyramid on a square: its edges to the top lean inwards."""
    solid = box(0.06, 0.06, 0.03)
    centre = np.array([0.03, 0.03, 0.0])
    top = solid.vertices[:, 2:] > 0.0
    return dataclasses.replace(
        solid, vertices=np.where(top, centre + 0.6 * (solid.vertices - centre), solid.vertices)
    )


def pyramid():
    vertices = np.array(
        [[0, 0, 0], [0.05, 0, 0], [0.05, 0.05, 0], [0, 0.05, 0], [0.02, 0.03, 0.04]]
    )
    faces = tuple(Face(k) for k in ((3, 2, 1, 0), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)))
    return ObjectModel(vertices, edges_of_faces(faces), faces)


SOLIDS = {"box": MODEL, "frustum": frustum(), "prism": prism(5), "pyramid": pyramid()}


def sheet():
    """The top of the box alone, as of a card, which has a size that no face can be asked about."""
    top = MODEL.faces[FACE_OF["top"]]
    vertices = MODEL.vertices[list(top.loop)]
    face = Face(tuple(range(4)))
    return ObjectModel(vertices, edges_of_faces([face]), (face,))


def lookup_of(pictures, views):
    return EdgeLookup.of(pictures, views.camera.image_size)


def asked(pictures, views, model=MODEL):
    lookup = lookup_of(pictures, views)
    lines = measured_lines(Wireframe.of(model, SAMPLES), views, lookup, POSE, EXPLAINED_DISTANCE)
    return likeliest_moved_face(POSE, model, lines, views, lookup)


def channel():
    """A bar with a groove along it: two of its faces are not convex, with sides in line."""
    outline = 0.01 * np.array([[0, 0], [6, 0], [6, 4], [4, 4], [4, 2], [2, 2], [2, 4], [0, 4]])
    ends = [np.column_stack([outline, np.full(8, y)]) for y in (0.0, 0.05)]
    walls = [Face((k, (k + 1) % 8, 8 + (k + 1) % 8, 8 + k)) for k in range(8)]
    faces = (*walls, Face(tuple(range(8))[::-1]), Face(tuple(range(8, 16))))
    return ObjectModel(np.concatenate(ends), edges_of_faces(faces), faces)


hidden_by = jax.jit(faces_before)


@pytest.mark.parametrize("face", [0, 2, 3, 5])
def test_faces_hide_the_same_after_one_is_moved(face):
    model = channel()
    movements = movements_of_face(model, face)
    wireframe = Wireframe.of(model)
    moved = _moved(wireframe, _rates(wireframe, model, movements), jnp.array(0.004))
    built = Wireframe.of(dataclasses.replace(model, vertices=model.vertices + 0.004 * movements))
    rng = np.random.default_rng(face)
    points = jnp.array(rng.uniform([-0.01, -0.01, -0.01], [0.07, 0.05, 0.06], (400, 3)))
    centre, last = jnp.array([0.2, 0.15, 0.3]), jnp.full(400, 0.999)
    before = [
        np.asarray(hidden_by(one.triangles, one.triangle_faces, centre, points, last))
        for one in (moved, built)
    ]
    assert before[1].any()
    np.testing.assert_array_equal(*before)


@pytest.mark.parametrize("name", ["box", "frustum", "prism"])
def test_a_moved_face_leaves_the_planes_of_all_others(name):
    model = SOLIDS[name]
    for face in range(len(model.faces)):
        moved = dataclasses.replace(
            model, vertices=model.vertices + 0.004 * movements_of_face(model, face)
        )
        for other in range(len(model.faces)):
            gap = moved.plane(other).origin - model.plane(other).origin
            away = gap @ model.plane(other).normal
            assert away == pytest.approx(0.004 if other == face else 0.0, abs=1e-12)
            np.testing.assert_allclose(
                moved.plane(other).normal, model.plane(other).normal, atol=1e-12
            )


def test_an_object_is_stretched_where_its_face_cannot_slide():
    """Two edges and more lead to each vertex of a pyramid's side."""
    model = SOLIDS["pyramid"]
    normal = model.plane(1).normal
    heights = (model.vertices - model.plane(1).origin) @ normal
    movements = movements_of_face(model, 1)
    np.testing.assert_allclose(movements[[0, 1, 4]], np.tile(normal, (3, 1)), atol=1e-12)
    np.testing.assert_allclose(
        movements, np.outer(1.0 - heights / heights.min(), normal), atol=1e-12
    )


@pytest.mark.parametrize("name", SOLIDS)
def test_what_is_found_is_that_of_a_model_with_the_face_there(views, name):
    model = SOLIDS[name]
    lookup = lookup_of(drawn(MODEL, views, POSE, 0.05), views)
    for face in range(len(model.faces)):
        movements = movements_of_face(model, face)
        places = face_places(model, movements, POSE, views)
        distances = places[[0, len(places) // 3, -1]]
        actual = _found_lengths(
            Wireframe.of(model, MOVED_SAMPLES),
            _rates(Wireframe.of(model, MOVED_SAMPLES), model, movements),
            distances,
            POSE,
            views,
            lookup,
        )
        for distance, px in zip(distances, actual, strict=True):
            moved = dataclasses.replace(model, vertices=model.vertices + distance * movements)
            wireframe = Wireframe.of(moved, SAMPLES)
            lines = measured_lines(wireframe, views, lookup, POSE, EXPLAINED_DISTANCE)
            # Samples stand at other places of the edges.
            assert px == pytest.approx(lines.explained_px.sum(), abs=40.0)


@pytest.mark.parametrize("name", SOLIDS)
def test_no_edge_vanishes_where_a_face_is_moved(views, name):
    model = SOLIDS[name]
    a, b = model.edges.T
    for face in range(len(model.faces)):
        movements = movements_of_face(model, face)
        places = face_places(model, movements, POSE, views)
        assert len(places) > 10
        for distance in (places[0], places[-1]):
            moved = model.vertices + distance * movements
            along, before = moved[b] - moved[a], model.vertices[b] - model.vertices[a]
            assert ((along * before).sum(axis=1) > 0.0).all()


@pytest.mark.parametrize(("axis", "stretch"), [(0, 0.7), (1, 1.4), (2, 1.4)])
def test_the_face_of_a_block_of_another_length_is_found_where_it_is(views, axis, stretch):
    block = box(*(SIDES * np.where(np.arange(3) == axis, stretch, 1.0)))
    actual = asked(drawn(block, views, POSE, 0.05), views)
    assert actual.face is not None
    assert MODEL.faces[actual.face].name == FAR[axis]
    assert actual.distance == pytest.approx((stretch - 1.0) * SIDES[axis], abs=6e-4)
    assert actual.gained_px > 150.0


def test_a_sheet_has_no_face_to_move_and_is_not_taken_for_a_solid(views):
    top = [k for k, edge in enumerate(MODEL.edges) if (MODEL.vertices[edge, 2] > 0.0).all()]
    pictures = drawn(MODEL, views, POSE, 0.05, hidden=top[:3])
    lookup = lookup_of(pictures, views)
    wireframe = Wireframe.of(sheet(), SAMPLES)
    lines = measured_lines(wireframe, views, lookup, POSE, EXPLAINED_DISTANCE)
    assert not movements_of_face(sheet(), 0).any()
    assert likeliest_moved_face(POSE, sheet(), lines, views, lookup) == (None, 0.0, 0.0)
    assert not evidence_of(lines, wireframe, False).has_faces
    whole = Wireframe.of(MODEL, SAMPLES)
    lines = measured_lines(whole, views, lookup, POSE, EXPLAINED_DISTANCE)
    assert evidence_of(lines, whole, False).has_faces


def test_a_view_that_looks_away_changes_nothing(views):
    """Behind a camera there are no pixels, and nothing moves there."""
    away = views.camera_from_world[:1].copy()
    away[:, :3] = np.diag([1.0, -1.0, -1.0]) @ away[:, :3]
    more = views._replace(camera_from_world=np.concatenate([views.camera_from_world, away]))
    movements = movements_of_face(MODEL, 0)
    np.testing.assert_allclose(
        face_places(MODEL, movements, POSE, more), face_places(MODEL, movements, POSE, views)
    )


def test_a_face_that_is_found_is_not_looked_for_elsewhere(views):
    """A second block next to the first, which continues all its edges, takes nothing from it."""
    second_pose = POSE.copy()
    second_pose[:3, 3] += POSE[:3, 0] * SIDES[0]
    pictures = together(*(drawn(MODEL, views, pose, 0.05) for pose in (POSE, second_pose)))
    assert asked(pictures, views) == (None, 0.0, 0.0)


def test_the_hidden_edges_of_an_object_are_nowhere(views):
    bar = host_exponentials(np.array([0.0, 0.0, 0.0, 1.3, 0.5, 0.3]))
    towards = views.centres.mean(axis=0) - MIDDLE
    bar[:3, 3] = MIDDLE + 0.15 * towards - bar[:3, :3] @ [0.006, 0.015, 0.04]
    behind = not_behind(drawn(MODEL, views, POSE, 0.05), views, BAR, bar)
    actual = asked(together(behind, drawn(BAR, views, bar, 0.05)), views)
    assert actual.gained_px < 60.0
