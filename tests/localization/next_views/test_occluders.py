"""What walls and other objects hide in views that were not taken, against Embree."""

import dataclasses

import numpy as np
import pytest
from drawn_edges import TWO_DIRECTIONS, calibration, drawn, evidence, poses_towards, seen_views
from scipy.spatial.transform import Rotation
from solids import box

from smartview_jax.geometry import host_exponentials, host_matrices, look_at
from smartview_jax.localization import Hypothesis, Reachable, Wireframe, localize, next_view
from smartview_jax.localization.edges.edge_lines import HIDING_DEPTH
from smartview_jax.localization.next_views.occluders import Occluder, hidden_in_views
from smartview_jax.modeling import Face, ObjectModel
from smartview_jax.simulation import random_polyhedron, roofed_block, stepped_block

MODEL = dataclasses.replace(box(), name="box")
POSE = host_exponentials(np.array([0.01, 0.02, 0.03, 0.1, -0.1, 0.4]))
MIDDLE = POSE[:3, :3] @ MODEL.vertices.mean(axis=0) + POSE[:3, 3]
SOLIDS = (
    stepped_block(0.06),
    roofed_block(0.06),
    random_polyhedron(np.random.default_rng(1), 12, 0.03),
)


@pytest.fixture(scope="module")
def found(few_samples):
    pictures = evidence(drawn(MODEL, seen_views(MIDDLE), POSE, 0.1))
    poses = poses_towards(MIDDLE, TWO_DIRECTIONS)
    start = Hypothesis(0, POSE, 0.0, 0.0)
    return localize(pictures, poses, calibration(), MODEL, hypotheses=[start])


def sheet(middle, normal, size):
    """Two triangles of a square at right angles to a direction."""
    across = np.linalg.svd(normal[None])[2][1:] * 0.5 * size
    corners = middle + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ across
    return corners[[[0, 1, 2], [0, 2, 3]]]


@pytest.mark.parametrize("solid", SOLIDS)
def test_hidden_points_are_those_that_embree_finds(solid):
    caster = pytest.importorskip("smartview_jax.simulation.ray_casting")
    rng = np.random.default_rng(5)
    model = ObjectModel(solid.vertices, solid.edges, tuple(Face(loop) for loop in solid.faces))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.4, 1.1, -0.7]).as_matrix()
    wireframe = Wireframe.of(model)
    in_world = np.asarray(wireframe.triangles) @ pose[:3, :3].T
    occluders = [Occluder(in_world, np.asarray(wireframe.triangle_faces))]
    moved = solid.moved(pose)
    rays = caster.RayCaster(moved.vertices, moved.triangles)
    centres = 0.4 * rng.standard_normal((5, 3))
    points = rng.uniform(-0.06, 0.06, (400, 3))
    hidden = hidden_in_views(occluders, centres, points)
    assert 0.1 < hidden.mean() < 0.9
    for centre, own in zip(centres, hidden, strict=True):
        # Those that start or end within a hand's breadth of the margin may differ.
        hits = rays.first_hits(centre, points - centre)
        reach = np.linalg.norm(hits.points - centre, axis=1)
        reach /= np.linalg.norm(points - centre, axis=1)
        expected = (hits.triangle != caster.MISSED) & (reach < 1.0 - HIDING_DEPTH)
        assert (own != expected).sum() <= 1


def test_walls_hide_both_ways_and_only_what_is_behind():
    wall = Occluder.of_triangles(sheet(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.2))
    points = np.array([[0.0, 0.0, -0.1], [0.0, 0.0, 0.1], [0.3, 0.0, -0.1]])
    centres = np.array([[0.01, 0.02, 0.5], [0.01, 0.02, -0.5]])
    hidden = hidden_in_views([wall], centres, points)
    np.testing.assert_array_equal(hidden, [[True, False, False], [False, True, False]])
    assert not hidden_in_views([], centres, points).any()


def two_views():
    """Two views from opposite sides, low enough that each shows something of its own."""
    up, side = POSE[:3, 2], POSE[:3, 0]
    return host_matrices(look_at(MIDDLE, -np.array([up + 0.8 * side, up - 0.8 * side]), 0.4))


def chosen(localizations, candidates, **options):
    view = next_view(localizations, calibration(), Reachable(candidates), **options)
    return int(np.abs(candidates - view.camera_from_world).max(axis=(1, 2)).argmin()), view


def test_a_view_behind_a_wall_is_not_chosen(found):
    candidates = two_views()
    free, view = chosen(found, candidates)
    towards = np.linalg.inv(candidates[free])[:3, 3] - MIDDLE
    wall = sheet(MIDDLE + 0.4 * towards, towards, 0.15)
    other, behind = chosen(found, candidates, occluders=wall)
    assert other == 1 - free
    assert behind.gain <= view.gain
    with pytest.raises(ValueError, match="occluders"):
        chosen(found, candidates, occluders=np.full((1, 3, 3), np.nan))


def test_a_view_behind_another_object_is_not_chosen(found):
    candidates = two_views()
    free, _ = chosen(found, candidates)
    towards = np.linalg.inv(candidates[free])[:3, 3] - MIDDLE
    moved = POSE.copy()
    moved[:3, 3] += 0.5 * towards
    localization = found[0]
    neighbour = localization._replace(
        refined=localization.refined._replace(world_from_object=moved)
    )
    assert chosen(found, candidates, neighbours=[neighbour])[0] == 1 - free
    # Where it is itself, an object hides nothing of itself; nor does what was rejected hide.
    assert chosen(found, candidates, neighbours=found)[0] == free
    rejected = neighbour._replace(verdict=neighbour.verdict._replace(decision="rejected"))
    assert chosen(found, candidates, neighbours=[rejected])[0] == free
