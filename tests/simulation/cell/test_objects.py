import numpy as np
import pytest
from scipy.spatial import ConvexHull

from smartview_jax.simulation import (
    CellObject,
    box,
    prism,
    random_polyhedron,
    roofed_block,
    stepped_block,
)
from smartview_jax.simulation.cell.objects import as_box, convex_parts

L_PROFILE = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]]) * 0.01
# Vertices of a T lie on lines between others, where no triangle without area may be cut off.
T_PROFILE = np.array([[0, 0], [3, 0], [3, 1], [2, 1], [2, 2], [1, 2], [1, 1], [0, 1]]) * 0.01


def volume(solid):
    trimesh = pytest.importorskip("trimesh")
    return trimesh.Trimesh(solid.vertices, solid.triangles, process=False).volume


@pytest.mark.parametrize(
    ("solid", "count"),
    [
        (box(0.06, 0.04, 0.03), 1),
        (stepped_block(0.05), 2),
        (prism(L_PROFILE, 0.02), 2),
        (prism(T_PROFILE, 0.02), 4),
        (roofed_block(0.05), 1),
        (random_polyhedron(np.random.default_rng(1), 12, 0.03), 1),
    ],
)
def test_convex_parts_fill_the_solid(solid, count):
    parts = convex_parts(solid)
    assert len(parts) == count
    assert np.isclose(sum(ConvexHull(part).volume for part in parts), volume(solid))


def test_what_is_neither_convex_nor_a_prism_is_refused():
    notched = stepped_block(0.05)
    # One corner of the step lifted: no translation maps one end to the other.
    vertices = notched.vertices.copy()
    vertices[4, 2] += 0.01
    with pytest.raises(ValueError, match="object odd: neither convex nor a prism"):
        CellObject("odd", notched._replace(vertices=vertices))


def test_a_box_is_recognised_at_any_pose():
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0.1, 0.2, 0.3]
    corners = box(0.06, 0.04, 0.03).moved(pose).vertices
    actual = as_box(corners)
    assert np.allclose(np.sort(actual.size), [0.03, 0.04, 0.06])
    assert np.isclose(np.linalg.det(actual.pose[:3, :3]), 1.0)
    # Its own corners are those that were given.
    own = (corners - actual.pose[:3, 3]) @ actual.pose[:3, :3]
    assert np.allclose(np.abs(own), 0.5 * actual.size)


def test_a_block_with_a_slope_is_no_box():
    vertices = box(0.06, 0.04, 0.03).vertices.copy()
    vertices[4:, 0] *= 0.9
    assert as_box(vertices) is None


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"density": 0.0}, "density is 0"),
        ({"friction": float("nan")}, "friction is nan"),
        ({"solid": box(60.0, 40.0, 30.0)}, "an extent of 60 m"),
    ],
)
def test_wrong_numbers_are_named(given, named):
    with pytest.raises(ValueError, match=f"object x: {named}"):
        CellObject(**{"name": "x", "solid": box(0.06, 0.04, 0.03), **given})
