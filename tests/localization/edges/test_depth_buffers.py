"""What known objects hide of others, against Embree and on drawn edges."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import calibration, camera, drawn, evidence, not_behind, seen_views, together
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from seen_scene import SAMPLES
from solids import box

from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Hypothesis, Wireframe, localize
from smartview_jax.localization.edges.edge_lookup import DEPTH_CELL_PX, DepthBuffers, EdgeLookup
from smartview_jax.localization.refining.refinement import measured_lines
from smartview_jax.modeling import Face, ObjectModel
from smartview_jax.simulation import random_polyhedron, roofed_block, stepped_block

BACK = dataclasses.replace(box(0.12, 0.08, 0.05), name="back")
FRONT = dataclasses.replace(box(0.07, 0.07, 0.03), name="front")
POSE = host_exponentials(np.array([0.01, 0.02, 0.03, 0.1, -0.1, 0.4]))
MIDDLE = POSE[:3, :3] @ BACK.vertices.mean(axis=0) + POSE[:3, 3]
VIEWS = seen_views(MIDDLE, distance=0.6)
TOWARDS_CAMERAS = VIEWS.centres.mean(axis=0) - MIDDLE


def front_pose():
    """Before one side of the object at the back, as both cameras see it."""
    pose = POSE.copy()
    pose[:3, 3] = MIDDLE + 0.2 * TOWARDS_CAMERAS + POSE[:3, :2] @ [0.0, -0.035]
    return pose


SOLIDS = (
    stepped_block(0.06),
    roofed_block(0.06),
    random_polyhedron(np.random.default_rng(1), 12, 0.03),
)


@pytest.fixture(scope="module")
def directions():
    """Of the middles of the parts of a picture, in the camera's frame."""
    rows, columns = DepthBuffers(VIEWS).inverse_depth.shape[1:]
    v, u = np.mgrid[:rows, :columns] * DEPTH_CELL_PX + 0.5 * (DEPTH_CELL_PX - 1)
    pixels = jnp.asarray(np.stack([u, v], axis=-1).reshape(-1, 2))
    return np.asarray(jax.jit(lambda cam, p: cam.unproject(p)[0])(camera(), pixels))


@pytest.mark.parametrize("solid", SOLIDS)
def test_depths_are_those_that_embree_finds(solid, directions):
    caster = pytest.importorskip("smartview_jax.simulation.ray_casting")
    model = ObjectModel(solid.vertices, solid.edges, tuple(Face(loop) for loop in solid.faces))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=3).as_matrix()
    pose[:3, 3] = MIDDLE
    known = DepthBuffers(VIEWS)
    known.add(Wireframe.of(model), pose)
    moved = solid.moved(pose)
    rays = caster.RayCaster(moved.vertices, moved.triangles)
    for view, camera_from_world in enumerate(VIEWS.camera_from_world):
        hits = rays.first_hits(VIEWS.centres[view], directions @ camera_from_world[:3, :3])
        depth = hits.points @ camera_from_world[2, :3] + camera_from_world[2, 3]
        expected = np.where(hits.triangle == caster.MISSED, 0.0, 1.0 / depth)
        # A ray along the border may be taken for either side.
        differ = np.abs(known.inverse_depth[view].ravel() - expected) > 1e-6
        assert (expected > 0.0).sum() > 500
        assert differ.sum() <= 2


def test_the_nearer_of_two_surfaces_is_kept():
    alone, both = DepthBuffers(VIEWS), DepthBuffers(VIEWS)
    alone.add(Wireframe.of(FRONT), front_pose())
    for model, pose in ((FRONT, front_pose()), (BACK, POSE)):
        both.add(Wireframe.of(model), pose)
    drawn_there = alone.inverse_depth > 0.0
    np.testing.assert_array_equal(both.inverse_depth[drawn_there], alone.inverse_depth[drawn_there])
    assert (both.inverse_depth > 0.0).sum() > 2 * drawn_there.sum()


def test_what_reaches_behind_a_camera_hides_nothing():
    known = DepthBuffers(VIEWS)
    pose = np.eye(4)
    pose[:3, 3] = VIEWS.centres[0]
    known.add(Wireframe.of(BACK), pose)
    assert not known.inverse_depth[0].any()


def test_edges_behind_a_known_surface_are_not_visible():
    wireframe = Wireframe.of(BACK, SAMPLES)
    known = DepthBuffers(VIEWS)
    known.add(Wireframe.of(FRONT), front_pose())
    pictures, size = drawn(BACK, VIEWS, POSE), VIEWS.camera.image_size
    plain, behind = (
        measured_lines(wireframe, VIEWS, EdgeLookup.of(pictures, size, None, depths), POSE, 2.0)
        for depths in (None, known.inverse_depth)
    )
    assert not plain.behind_px.any()
    assert (behind.behind_px > 200.0).all()
    np.testing.assert_allclose(
        behind.visible_px.sum(axis=1) + behind.behind_px, plain.visible_px.sum(axis=1)
    )
    # The object itself does not hide its own edges, unless a camera looks along one of its faces.
    turned = POSE @ host_exponentials(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1]))
    known = DepthBuffers(VIEWS)
    known.add(Wireframe.of(BACK), turned)
    lookup = EdgeLookup.of(drawn(BACK, VIEWS, turned), size, None, known.inverse_depth)
    own = measured_lines(wireframe, VIEWS, lookup, turned, 2.0)
    assert own.behind_px.sum() < 0.02 * own.visible_px.sum()


def test_known_triangles_hide_as_an_object_does():
    solid = stepped_block(0.06)
    pose = np.eye(4)
    pose[:3, 3] = MIDDLE
    by_faces, by_triangles = DepthBuffers(VIEWS), DepthBuffers(VIEWS)
    model = ObjectModel(solid.vertices, solid.edges, tuple(Face(loop) for loop in solid.faces))
    by_faces.add(Wireframe.of(model), pose)
    moved = solid.moved(pose)
    by_triangles.add_triangles(moved.vertices[moved.triangles])
    differ = np.abs(by_faces.inverse_depth - by_triangles.inverse_depth) > 1e-9
    assert (by_faces.inverse_depth > 0.0).sum() > 1000
    # A ray along the border may be taken for either side.
    assert differ.sum() <= 4


def test_what_an_accepted_object_hides_is_not_held_against_another():
    """The one at the back is judged first, because it is larger, and again with what hides it."""
    at_back = not_behind(drawn(BACK, VIEWS, POSE, shift=0.8), VIEWS, FRONT, front_pose())
    in_front = drawn(FRONT, VIEWS, front_pose(), hidden=(4, 5, 6))
    poses = np.linalg.inv(VIEWS.camera_from_world)
    pictures = evidence(together(at_back, in_front))
    hypotheses = [Hypothesis(0, POSE, 0.0, 0.0), Hypothesis(1, front_pose(), 0.0, 0.0)]
    (alone,) = localize(pictures, poses, calibration(), BACK, hypotheses=hypotheses[:1])
    assert alone.verdict.decision == "open"
    walls = FRONT.vertices @ front_pose()[:3, :3].T + front_pose()[:3, 3]
    triangles = walls[ConvexHull(walls).simplices]
    (told,) = localize(
        pictures, poses, calibration(), BACK, hypotheses=hypotheses[:1], occluders=triangles
    )
    assert told.accepted
    with pytest.raises(ValueError, match="occluders: expected finite triangles"):
        localize(pictures, poses, calibration(), BACK, occluders=np.full((1, 3, 3), np.nan))
    localizations = localize(pictures, poses, calibration(), [BACK, FRONT], hypotheses=hypotheses)
    assert {obj.model.name for obj in localizations.accepted} == {"back", "front"}
    (back,) = (obj for obj in localizations if obj.model.name == "back")
    assert back.verdict.evidence.in_front < 0.9
    assert back.verdict.evidence.explained > alone.verdict.evidence.explained + 0.1
