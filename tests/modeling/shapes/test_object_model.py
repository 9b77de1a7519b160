import dataclasses

import numpy as np
import pytest
from solids import box, prism

from smartview_jax.modeling import (
    Face,
    ObjectModel,
    check_face,
    face_plane,
    grasp_on_face,
    open_edges,
    oriented_outward,
    signed_volume,
)

trimesh = pytest.importorskip("trimesh")

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def test_a_box_is_closed_and_its_normals_point_outward():
    model = box()
    assert not open_edges(model.faces)
    assert signed_volume(model.vertices, model.faces) == pytest.approx(0.06 * 0.04 * 0.03)
    middle = model.vertices.mean(axis=0)
    for k in range(6):
        plane = model.plane(k)
        assert plane.normal @ (plane.origin - middle) > 0.0
        np.testing.assert_allclose(plane.axes @ plane.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(plane.axes) == pytest.approx(1.0)
    assert sum(model.plane(k).area for k in range(6)) == pytest.approx(
        trimesh.creation.box((0.06, 0.04, 0.03)).area
    )


@pytest.mark.parametrize("tolerance", [-1e-4, 0.5, np.nan])
def test_a_tolerance_is_small_and_in_metres(tolerance):
    with pytest.raises(ValueError, match="tolerance: expected metres, from 0 to 10%"):
        dataclasses.replace(box(), tolerance=tolerance)


def test_faces_turned_over_are_put_right():
    rng = np.random.default_rng(0)
    model = prism(7)
    mixed = [face.reversed if rng.random() < 0.5 else face for face in model.faces]
    assert open_edges(mixed)
    assert oriented_outward(model.vertices, mixed) == model.faces
    # A mirrored model has all normals inward until it is oriented.
    mirrored = model.vertices * [1.0, 1.0, -1.0]
    faces = oriented_outward(mirrored, model.faces)
    assert signed_volume(mirrored, faces) == pytest.approx(
        signed_volume(model.vertices, model.faces)
    )


def test_a_hole_counts_in_area_and_closedness():
    inner = 0.25 + 0.5 * SQUARE
    inner[:, 2] = 0.0
    vertices = np.concatenate([SQUARE, inner])
    model = ObjectModel(vertices, faces=(Face((0, 1, 2, 3), ((4, 5, 6, 7),)),))
    assert model.faces[0].holes == ((7, 6, 5, 4),)  # the other way round than the outer loop
    assert model.plane(0).area == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("loop", "holes", "vertices", "said"),
    [
        ((0, 1), (), SQUARE, "a loop of 2 vertices"),
        ((0, 1, 2, 4), (), SQUARE, "vertex 4 does not exist: the model has 4"),
        ((0, 1, 2, 1), (), SQUARE, "meets vertex 1 2 times"),
        ((0, 2, 1, 3), (), SQUARE * [1, 1.2, 1], r"crosses itself|no area"),
        ((0, 1, 2, 3), (), SQUARE + 0.2 * np.eye(4)[:, [0, 0, 2]] * [0, 0, 1], "not planar"),
        ((0, 1, 2), (), SQUARE * [1, 0, 0], "no area"),
        ((0, 1, 2, 3), ((4, 5, 6),), np.concatenate([SQUARE, 2 + SQUARE[:3]]), "not planar|hole"),
    ],
)
def test_what_is_wrong_with_a_face_is_said(loop, holes, vertices, said):
    with pytest.raises(ValueError, match=said):
        check_face(vertices, Face(loop, holes))
    with pytest.raises(ValueError, match=r"face 0 \(roof\): "):
        ObjectModel(vertices, faces=(Face(loop, holes, "roof"),))


def test_a_face_that_crosses_itself_names_the_sides():
    bow = np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0], [3, 2, 0]])
    with pytest.raises(ValueError, match=r"side \(1, 2\) crosses side \(3, 0\)"):
        check_face(bow, Face((0, 1, 2, 3)))
    with pytest.raises(ValueError, match="crosses itself, so that its two halves cancel"):
        check_face(SQUARE[[0, 2, 1, 3]], Face((0, 1, 2, 3)))
    star = np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0], [2, 1, 0], [0, 4, 0]])
    check_face(star, Face((0, 1, 2, 3, 4)))  # not convex, yet it does not cross itself
    outside = np.concatenate([SQUARE, SQUARE * 0.1 + [2.0, 0, 0]])
    with pytest.raises(ValueError, match="is not inside"):
        check_face(outside, Face((0, 1, 2, 3), ((4, 5, 6, 7),)))


def test_an_uncertain_vertex_may_be_off_the_plane():
    bent = SQUARE + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0.1], [0, 0, 0]])
    with pytest.raises(ValueError, match="not planar"):
        check_face(bent, Face((0, 1, 2, 3)))
    check_face(bent, Face((0, 1, 2, 3)), np.full(4, 0.02))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"vertices": np.full((2, 3), np.nan), "faces": ()}, "vertex 0: not finite"),
        ({"vertices": 1e4 * SQUARE, "faces": ()}, "expected metres"),
        ({"edges": np.array([[0, 9]])}, "edge 0 .* leads to vertex 9, which does not exist"),
        ({"edges": np.array([[0, 1], [2, 2]])}, "from vertex 2 to itself"),
        ({"edges": np.array([[0, 1], [1, 0]])}, "listed twice"),
        ({"covariance": np.zeros((3, 3, 3))}, "covariance"),
        ({"covariance": np.triu(np.ones((24, 24)))}, "symmetric"),
        ({"calibration_factor": np.zeros((5, 2))}, "calibration_factor"),
    ],
)
def test_a_model_with_a_wrong_part_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(box(), **change)


def test_an_open_surface_names_its_edges():
    assert open_edges(box().faces[:5]) == [(1, 3), (1, 5), (3, 7), (5, 7)]


def test_the_calibrations_common_error_cancels_in_distances():
    """Against distances of many drawn vertices."""
    rng = np.random.default_rng(1)
    count = 8
    shift = np.tile(np.eye(3), (count, 1)) * 1e-3  # moves the object as a whole
    own = rng.normal(size=(3 * count, 2)) * 2e-4
    noise = rng.normal(size=(3 * count, 3 * count)) * 5e-5
    model = dataclasses.replace(
        box(), covariance=noise @ noise.T, calibration_factor=np.concatenate([shift, own], axis=1)
    )
    full = noise @ noise.T + shift @ shift.T + own @ own.T
    drawn = rng.multivariate_normal(model.vertices.ravel(), full, 20000).reshape(-1, count, 3)
    length, sigma = model.distance(0, 7)
    lengths = np.linalg.norm(drawn[:, 7] - drawn[:, 0], axis=1)
    assert length == pytest.approx(np.linalg.norm([0.06, 0.04, 0.03]))
    assert sigma == pytest.approx(lengths.std(), rel=0.03)
    blocks = np.stack([np.cov(drawn[:, k].T) for k in range(count)])
    np.testing.assert_allclose(model.vertex_covariances, blocks, atol=6e-8)
    assert model.vertex_sigma[0] > 0.9e-3 > sigma
    with pytest.raises(ValueError, match="in one place"):
        model.distance(2, 2)


def test_a_grasp_approaches_along_the_inward_normal():
    model = box()
    grasp = grasp_on_face(model, 1, depth=0.01, name="top")
    np.testing.assert_allclose(grasp.approach, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(grasp.position, [0.03, 0.02, 0.03], atol=1e-12)
    # Across the longest edge: the fingers close on the 40 mm, with 20 % of room by default.
    np.testing.assert_allclose(np.abs(grasp.opening_direction), [0, 1, 0], atol=1e-12)
    assert grasp.opening == pytest.approx(0.048)
    assert grasp.tolerance == pytest.approx(0.004)
    assert np.linalg.det(grasp.object_from_tool[:3, :3]) == pytest.approx(1.0)
    # Below the box nothing is between the fingers; then the face's own extent is taken.
    assert grasp_on_face(model, 1, depth=0.5).opening == pytest.approx(0.048)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"face": 6}, "face 6 does not exist"),
        ({"position": np.array([0.2, 0.0, 0.0])}, "not on face"),
        ({"opening_direction": np.array([0.0, 0.0, 1.0])}, "along the normal"),
        ({"opening": 0.03}, "40 mm wide there"),
        ({"depth": -0.01}, "at a depth of -10 mm"),
    ],
)
def test_an_impossible_grasp_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        grasp_on_face(box(), **{"face": 1, **given})


def test_the_width_is_that_of_a_ray_through_the_mesh():
    """As trimesh finds it, on a solid that is not convex."""
    from smartview_jax.modeling import width_between_fingers

    outline = np.array([[0, 0], [6, 0], [6, 4], [4, 4], [4, 2], [2, 2], [2, 4], [0, 4]]) * 0.01
    vertices = np.concatenate([np.column_stack([outline, np.full(8, h)]) for h in (0.0, 0.03)])
    walls = [(k, (k + 1) % 8, 8 + (k + 1) % 8, 8 + k) for k in range(8)]
    faces = tuple(map(Face, [*walls, tuple(range(8))[::-1], tuple(range(8, 16))]))
    model = ObjectModel(vertices, faces=faces)
    rng = np.random.default_rng(3)
    triangles = np.array([[0, 1, 5], [0, 5, 7], [7, 5, 6], [1, 2, 4], [1, 4, 5], [2, 3, 4]])
    mesh = trimesh.creation.extrude_triangulation(outline, triangles, 0.03)
    for _ in range(10):
        direction = np.append(rng.normal(size=2), 0.1 * rng.normal())
        direction /= np.linalg.norm(direction)
        pose = np.eye(4)
        pose[:3, 3] = [0.03, 0.01, 0.015]
        pose[:3, 0] = direction
        hits, *_ = mesh.ray.intersects_location(
            [pose[:3, 3]] * 2, [direction, -direction], multiple_hits=True
        )
        along = (hits - pose[:3, 3]) @ direction
        assert width_between_fingers(model, pose) == pytest.approx(np.ptp(along), abs=1e-6)


def test_a_plane_needs_an_area():
    with pytest.raises(ValueError, match="no area"):
        face_plane(SQUARE * [1.0, 0.0, 0.0], Face((0, 1, 2, 3)))
