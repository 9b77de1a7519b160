import numpy as np
import pytest
from drawn_edges import predicted
from seen_scene import CAMERA, errors, seen_scene, shaken

from smartview_jax.features import IdealPlane
from smartview_jax.localization import (
    SceneMaps,
    Wireframe,
    polished_poses,
    score_poses,
)

GATE = 5.0


@pytest.fixture(scope="module")
def scene():
    return seen_scene()


@pytest.fixture(scope="module")
def maps(scene):
    return SceneMaps.of(scene.evidence, scene.views)


@pytest.fixture(scope="module")
def wireframe(scene):
    return Wireframe.of(scene.models[0])


def lengths_by_tree(scene, wireframe, pose):
    """The three lengths from the predicted view through the lens and a tree over edge points."""
    plane, lengths = IdealPlane(CAMERA), np.zeros(3)
    for evidence, camera_from_world in zip(
        scene.evidence, scene.views.camera_from_world, strict=True
    ):
        view = predicted(wireframe, CAMERA, camera_from_world @ pose)
        seen = np.asarray(view.sample_visible)
        pixels, directions = np.asarray(view.samples)[seen], np.asarray(view.directions)[seen]
        px = np.asarray(view.sample_px)[seen]
        points = plane.to_pixels(evidence.maps.points)[0]
        across = np.abs(directions @ evidence.maps.normals.T) < np.sin(np.deg2rad(22.5))
        gaps = np.linalg.norm(pixels[:, None] - points, axis=2)
        near = np.where(across, gaps, np.inf).min(axis=1)
        weight = np.maximum(1.0 - (near / GATE) ** 2, 0.0)
        lengths += [px.sum(), px[weight > 0.0].sum(), px @ weight]
    return lengths


def test_scores_are_lengths_near_edges_of_the_pictures(scene, maps, wireframe):
    rng = np.random.default_rng(0)
    poses = shaken(scene.world_from_object[0], rng, 3.0, 2.0, 6)
    poses[0] = scene.world_from_object[0]
    scores = np.stack(score_poses(maps, wireframe, poses, GATE), axis=1)
    expected = np.array([lengths_by_tree(scene, wireframe, pose) for pose in poses])
    np.testing.assert_allclose(scores[:, 0], expected[:, 0], rtol=0.03)
    # Cells of a pixel, and directions sorted into eight maps, are coarser than the tree.
    assert np.abs(scores - expected).max() < 0.08 * expected[:, 0].max()
    assert scores[0, 1] > 0.95 * scores[0, 0]
    assert (scores[1:, 2] < scores[0, 2]).all()


def test_scores_do_not_depend_on_the_other_poses(scene, maps, wireframe):
    poses = shaken(scene.world_from_object[0], np.random.default_rng(1), 20.0, 20.0, 1500)
    every = score_poses(maps, wireframe, poses, GATE)
    some = score_poses(maps, wireframe, poses[1200:1203], GATE)
    for all_of, few in zip(every, some, strict=True):
        np.testing.assert_allclose(few, all_of[1200:1203], rtol=1e-5)
    assert len(score_poses(maps, wireframe, poses[:0], GATE).support_px) == 0


def test_what_is_outside_the_pictures_is_not_explained(scene, maps, wireframe):
    truth = scene.world_from_object[0]
    away, behind = truth.copy(), truth.copy()
    away[:2, 3] += 0.6
    behind[2, 3] += 1.0
    scores = score_poses(maps, wireframe, np.stack([truth, away, behind]), GATE)
    assert scores.visible_px[1] == scores.visible_px[2] == 0.0
    assert scores.explained[1] == scores.support_px[1] == scores.visible_px[1] == 0.0
    # Half outside: what would be seen there counts, without support.
    edge = truth.copy()
    edge[0, 3] += 0.13
    half = score_poses(maps, wireframe, edge[None], GATE)
    assert half.visible_px[0] > 0.7 * scores.visible_px[0]
    assert half.explained[0] < 0.6


def test_poses_some_degrees_away_are_drawn_to_the_truth(scene, maps, wireframe):
    rng, truth = np.random.default_rng(2), scene.world_from_object[0]
    poses = shaken(truth, rng, 4.0, 3.0, 80)
    moved = polished_poses(maps, wireframe, poses)
    angles, shifts = errors(scene.models[0], moved, truth)
    assert ((angles < 0.3) & (shifts < 0.3)).mean() > 0.9
    np.testing.assert_allclose(
        moved[:, :3, :3] @ moved[:, :3, :3].transpose(0, 2, 1),
        np.eye(3)[None].repeat(80, 0),
        atol=1e-12,
    )


def test_poses_that_no_edge_holds_stay_finite(scene, maps, wireframe):
    away = scene.world_from_object[0].copy()
    away[:2, 3] += 0.6
    moved = polished_poses(maps, wireframe, away[None])
    np.testing.assert_allclose(moved[0], away, atol=1e-6)


def test_views_and_pictures_have_to_belong_together(scene):
    with pytest.raises(ValueError, match="each of 2 views, and at least one; found 1"):
        SceneMaps.of(scene.evidence[:1], scene.views)
