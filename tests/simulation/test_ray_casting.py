import sys

import numpy as np
import pytest

from smartview_jax.simulation.polyhedra import face_normal, random_polyhedron
from smartview_jax.simulation.ray_casting import MISSED, RayCaster

pytest.importorskip("embreex")
pytest.importorskip("trimesh")


def test_rays_meet_a_convex_solid_where_its_planes_say():
    """A convex solid is where n . x <= d for every face: a ray enters at the last entry."""
    rng = np.random.default_rng(0)
    solid = random_polyhedron(rng, 14)
    origin = np.array([0.05, -0.08, 0.15])
    directions = rng.standard_normal((5000, 3)) * 0.02 + np.array([0.0, 0.0, 0.02]) - origin
    hits = RayCaster(solid.vertices, solid.triangles).first_hits(origin, directions)
    normals = np.array([face_normal(solid.vertices, face) for face in solid.faces])
    offsets = np.array(
        [n @ solid.vertices[f[0]] for n, f in zip(normals, solid.faces, strict=True)]
    )
    speed, distance = directions @ normals.T, (offsets - normals @ origin)
    crossing = distance / speed
    enters = np.where(speed < 0.0, crossing, -np.inf).max(axis=1)
    leaves = np.where(speed > 0.0, crossing, np.inf).min(axis=1)
    # Rays that graze an edge may go either way in single precision.
    clear = np.abs(leaves - enters) > 1e-4
    assert clear.mean() > 0.99
    hit = hits.triangle != MISSED
    np.testing.assert_array_equal(hit[clear], (enters < leaves)[clear])
    both = hit & clear
    assert both.mean() > 0.2
    expected = origin + enters[both, None] * directions[both]
    np.testing.assert_allclose(hits.points[both], expected, atol=1e-12)
    assert (np.einsum("ij,ij->i", hits.normals, directions)[both] < 0.0).all()


def test_the_nearer_of_two_triangles_is_hit_and_casts_the_shadow():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]])
    vertices = np.concatenate([np.column_stack([s * square, [z] * 3]) for s, z in ((9, 0), (1, 1))])
    caster = RayCaster(vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    rays = np.array([[0.0, 0.0, -1.0], [0.0, -4.0, -3.0], [0.0, 0.0, 1.0]])
    hits = caster.first_hits(np.array([0.0, 0.0, 3.0]), rays)
    np.testing.assert_array_equal(hits.triangle, [1, 0, MISSED])
    np.testing.assert_allclose(hits.points[:2], [[0.0, 0.0, 1.0], [0.0, -4.0, 0.0]], atol=1e-12)
    up = np.array([0.0, 0.0, 1.0])
    below, outside = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    hidden = caster.is_hidden(np.stack([below, outside]), np.stack([up, up]), up)
    np.testing.assert_array_equal(hidden, [True, False])


@pytest.mark.parametrize(
    ("vertices", "triangles", "message"),
    [
        (np.eye(3), np.zeros((0, 3), int), "expected at least one"),
        (np.eye(3), np.array([[0, 1, 3]]), "index 3"),
        (np.diag([1.0, np.nan, 1.0]), np.array([[0, 1, 2]]), "vertex 1 is not finite"),
        (np.eye(3), np.array([[0, 1, 2], [0, 1, 1]]), "triangle 1 has no area"),
    ],
)
def test_what_is_no_mesh_is_refused(vertices, triangles, message):
    with pytest.raises(ValueError, match=message):
        RayCaster(vertices, triangles)


@pytest.mark.parametrize("missing", ["trimesh", "embreex"])
def test_the_error_names_the_extra_to_install(monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r"smartview-jax\[objects\]"):
        RayCaster(np.eye(3), np.array([[0, 1, 2]]))
