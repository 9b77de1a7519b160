import numpy as np
import pytest
from seen_scene import CALIBRATION, CAMERA, errors, seen_scene
from solids import moved

from smartview_jax.features import IdealPlane, picture_evidence
from smartview_jax.localization import (
    SearchOptions,
    Wireframe,
    distinct_poses,
    find_hypotheses,
    pose_distances,
)
from smartview_jax.localization.search.corner_poses import (
    model_paths,
    picture_paths,
    poses_from_paths,
)
from smartview_jax.localization.search.stereo_edges import (
    model_edges,
    poses_from_edges,
    stereo_edges,
)
from smartview_jax.modeling import ObjectModel, SeenViews


@pytest.fixture(scope="module")
def scene():
    return seen_scene()


@pytest.fixture(scope="module")
def one_view(scene):
    return SeenViews.of(CALIBRATION, np.linalg.inv(scene.views.camera_from_world[:1]))


def refused(*_):
    raise AssertionError("three distant junctions")


@pytest.fixture(scope="module")
def found(scene):
    """What two views propose; they keep exactly what edges in space and paths do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("smartview_jax.localization.search.hypotheses.poses_from_triples", refused)
        return find_hypotheses(scene.evidence, scene.views, scene.models)


def test_both_objects_are_found_from_two_views(scene, found):
    assert [hypothesis.score for hypothesis in found] == sorted(
        (hypothesis.score for hypothesis in found), reverse=True
    )
    for index, (model, truth) in enumerate(zip(scene.models, scene.world_from_object, strict=True)):
        best = next(hypothesis for hypothesis in found if hypothesis.model == index)
        angles, shifts = errors(model, best.world_from_object[None], truth)
        assert angles[0] < 0.3
        assert shifts[0] < 0.3
        assert best.explained > 0.7


def test_an_object_of_many_corners_is_found_from_one_view(scene, one_view):
    few = SearchOptions(hypotheses=5)
    hypotheses = find_hypotheses(scene.evidence[:1], one_view, scene.models[:1], options=few)
    assert len(hypotheses) == 5
    poses = np.array([hypothesis.world_from_object for hypothesis in hypotheses])
    angles, shifts = errors(scene.models[0], poses, scene.world_from_object[0])
    # One view gives the distance ten times less well than two.
    assert ((angles < 1.0) & (shifts < 2.0))[:2].any()


def test_distant_junctions_are_searched_for_in_one_view_only(scene, one_view, found, monkeypatch):
    assert found
    monkeypatch.setattr("smartview_jax.localization.search.hypotheses.poses_from_triples", refused)
    with pytest.raises(AssertionError, match="three distant junctions"):
        find_hypotheses(scene.evidence[:1], one_view, scene.models[:1])


def test_equal_poses_of_a_symmetric_object_are_listed_once(scene, found):
    model, truth = scene.models[1], scene.world_from_object[1]
    assert model.symmetry.order == 4
    poses = np.array(
        [hypothesis.world_from_object for hypothesis in found if hypothesis.model == 1]
    )
    angles, shifts = errors(model, poses, truth)
    assert ((angles < 2.0) & (shifts < 2.0)).sum() == 1


def test_pictures_without_segments_give_no_hypotheses(scene, one_view):
    """A soft gradient is not blank, and has nothing to find."""
    ramp = np.tile(np.linspace(20, 220, CAMERA.image_size[0]).astype(np.uint8), (480, 1))
    evidence = [picture_evidence(ramp, CAMERA)] * 2
    assert not len(evidence[0].features.segments)
    assert find_hypotheses(evidence, scene.views, scene.models) == []
    assert find_hypotheses(evidence[:1], one_view, scene.models) == []


def test_searches_without_models_pictures_or_edges_are_refused(scene):
    with pytest.raises(ValueError, match="models: expected at least one"):
        find_hypotheses(scene.evidence, scene.views, [])
    with pytest.raises(ValueError, match="evidence: expected one for each of 2 views"):
        find_hypotheses([], scene.views, scene.models)
    points = ObjectModel(scene.models[0].vertices, name="points")
    with pytest.raises(ValueError, match="'points' has no edges"):
        find_hypotheses(scene.evidence, scene.views, [points])


def test_a_workspace_keeps_what_is_outside_of_it_from_the_list(scene, one_view):
    """The table is at z = 0; one view alone takes a small near object for a large far one."""
    table = np.array([[0.3, 0.3, 0.0], [-0.3, -0.3, 0.1]])
    model = scene.models[1]
    anywhere = find_hypotheses(scene.evidence[:1], one_view, [model])
    hypotheses = find_hypotheses(scene.evidence[:1], one_view, [model], workspace=table)
    heights = [
        np.array(
            [
                (hypothesis.world_from_object @ [*v, 1.0])[2]
                for hypothesis in listed
                for v in model.vertices
            ]
        )
        for listed in (anywhere, hypotheses)
    ]
    assert heights[0].min() < -0.02
    assert heights[1].min() > -0.006
    assert len(hypotheses) > 5
    with pytest.raises(ValueError, match="workspace: expected two corners"):
        find_hypotheses(scene.evidence, scene.views, [model], workspace=np.nan * table)


def test_paths_of_one_picture_propose_the_true_pose(scene):
    model, truth = scene.models[0], scene.world_from_object[0]
    paths = picture_paths(scene.evidence[0].features, IdealPlane(CAMERA), 200)
    assert 10 < len(paths.rays) <= 200
    poses = poses_from_paths(paths, model, scene.views.camera_from_world[0])
    angles, shifts = errors(model, poses, truth)
    assert ((angles < 3.0) & (shifts < 3.0)).any()
    assert len(picture_paths(scene.evidence[0].features, IdealPlane(CAMERA), 7).rays) == 7


def test_a_box_has_six_paths_about_each_vertex(scene):
    paths = model_paths(scene.models[1])
    assert len(paths) == 8 * 6
    assert len({tuple(path) for path in paths.tolist()}) == 48


def test_edges_in_two_pictures_propose_the_true_pose(scene):
    model, truth = scene.models[0], scene.world_from_object[0]
    edges = stereo_edges(
        scene.evidence[0].features,
        scene.evidence[1].features,
        (IdealPlane(CAMERA),) * 2,
        scene.views.camera_from_world,
    )
    # Some of the edges in space are the object's.
    true = moved(model, truth)
    starts, ends = true.vertices[true.edges].transpose(1, 0, 2)
    along = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    offset = edges.points[:, None] - starts
    across = np.linalg.norm(offset - (offset * along).sum(axis=2, keepdims=True) * along, axis=2)
    alike = np.abs(edges.directions @ along.T) > np.cos(np.deg2rad(2.0))
    assert ((across < 1e-3) & alike).any(axis=0).sum() >= 6
    angles, shifts = errors(model, poses_from_edges(edges, model), truth)
    assert ((angles < 1.0) & (shifts < 1.0)).sum() >= 3


def test_exact_edges_give_exact_poses(scene):
    model, truth = scene.models[0], scene.world_from_object[0]
    edges = model_edges(moved(model, truth))
    poses = poses_from_edges(edges, model)
    angles, shifts = errors(model, poses, truth)
    assert ((angles < 1e-5) & (shifts < 1e-6)).sum() > 20


def test_two_pictures_from_one_place_have_no_edges_in_space(scene):
    twice = scene.views.camera_from_world[[0, 0]]
    features = scene.evidence[0].features
    assert not len(stereo_edges(features, features, (IdealPlane(CAMERA),) * 2, twice).points)


def test_pose_distances_are_those_of_the_vertices(scene):
    model, rng = scene.models[1], np.random.default_rng(0)
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.standard_normal((20, 3, 3)))[0]
    poses[:, :3, :3] *= np.linalg.det(poses[:, :3, :3])[:, None, None]
    poses[:, :3, 3] = rng.uniform(-0.1, 0.1, (20, 3))

    def moved(pose):
        return model.vertices @ pose[:3, :3].T + pose[:3, 3]

    expected = [
        min(
            np.sqrt(((moved(poses[0] @ turn) - moved(other)) ** 2).sum(axis=1).mean())
            for turn in model.symmetry.object_from_object
        )
        for other in poses
    ]
    np.testing.assert_allclose(pose_distances(model, poses[0], poses), expected, atol=1e-12)
    equal = poses[0] @ model.symmetry.object_from_object
    np.testing.assert_allclose(pose_distances(model, poses[0], equal), 0.0, atol=1e-9)
    kept = distinct_poses(model, np.concatenate([equal, poses]), 100)
    assert kept[0] == 0
    assert not np.isin(kept, [1, 2, 3, 4]).any()
    assert len(distinct_poses(model, poses, 3)) == 3


def test_wireframes_for_the_search_are_small(scene):
    assert len(Wireframe.of(scene.models[0], 24, per_edge=1).samples) <= 48
