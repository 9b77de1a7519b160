import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solids import box

import smartview_jax as sv
from smartview_jax.cameras import Pinhole
from smartview_jax.features import Features, IdealPlane
from smartview_jax.localization import Wireframe
from smartview_jax.localization.search.corner_poses import (
    COMPARED_TRIPLES,
    MAX_JUNCTIONS,
    MAX_TRIPLES,
    SEARCH_SHARE,
    Junctions,
    poses_from_triples,
)
from smartview_jax.localization.search.corner_poses import _vertex_triples as vertex_triples

FOCAL, CENTRE = 1000.0, np.array([640.0, 480.0])
CAMERA = sv.Camera(FOCAL, FOCAL, 640.0, 480.0, Pinhole(), (1280, 960))
PLANE = IdealPlane(CAMERA)
MODEL = box()
WIREFRAME = Wireframe.of(MODEL)
EXTENT = float(np.linalg.norm(np.ptp(MODEL.vertices, axis=0)))
MIDDLE = MODEL.vertices.mean(axis=0)
CAMERA_FROM_WORLD = np.eye(4)
CAMERA_FROM_WORLD[:3, :3] = Rotation.from_rotvec([0.3, -0.8, 0.4]).as_matrix()
CAMERA_FROM_WORLD[:3, 3] = [0.1, -0.2, 0.3]
ALONG = ("face seen frontally", "edge seen from its end", "anyhow")


def random_pose(rng, how="anyhow"):
    """camera_from_object before the camera, at five times the object's extent."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
    if how == "face seen frontally":
        pose[:3, :3] = Rotation.from_euler("z", rng.uniform(0.0, 6.0)).as_matrix()
    if how == "edge seen from its end":
        pose[:3, :3] = Rotation.from_euler("xz", [0.5 * np.pi + 0.25, 0.3]).as_matrix()
    middle = 5.0 * EXTENT * np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    pose[:3, 3] = middle - pose[:3, :3] @ MIDDLE
    return pose


def seen(points, pose):
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    return CENTRE + FOCAL * moved[:, :2] / moved[:, 2:]


def features_at(pose, shifts=(0.0, 0.0), turn=0.0):
    """All vertices as corners, with stubs of a third of each edge: none is seen from end to end."""
    corners = seen(MODEL.vertices, pose) + np.asarray(shifts)
    ends = np.concatenate([MODEL.edges, MODEL.edges[:, ::-1]])
    stubs = (corners[ends[:, 1]] - corners[ends[:, 0]]) / 3.0
    stubs = stubs @ Rotation.from_euler("z", turn).as_matrix()[:2, :2].T
    segments = np.stack([corners[ends[:, 0]], corners[ends[:, 0]] + stubs], axis=1)
    joined = np.full((len(corners), 4), -1)
    for k in range(len(corners)):
        own = np.flatnonzero(ends[:, 0] == k)
        joined[k, : len(own)] = own
    return Features(
        corners,
        np.tile(np.eye(2), (len(corners), 1, 1)),
        joined,
        segments,
        np.tile(np.eye(2), (len(segments), 2, 1, 1)),
        np.zeros((len(segments), 3)),
        np.zeros((len(segments), 3, 3)),
        CAMERA.image_size,
    )


def roughly(pose, rng, degrees=4.0):
    """A pose turned about the object's middle, and moved a little."""
    turn = np.eye(4)
    axis = rng.standard_normal(3)
    turn[:3, :3] = Rotation.from_rotvec(
        np.deg2rad(degrees) * axis / np.linalg.norm(axis)
    ).as_matrix()
    turn[:3, 3] = MIDDLE - turn[:3, :3] @ MIDDLE + 0.01 * EXTENT * rng.standard_normal(3)
    return pose @ turn


def found_near(features, rough):
    """Return camera_from_object of the hypotheses near a pose."""
    junctions = Junctions.of(features, PLANE, CAMERA_FROM_WORLD)
    world = np.linalg.inv(CAMERA_FROM_WORLD) @ rough[None]
    return CAMERA_FROM_WORLD @ poses_from_triples(junctions, WIREFRAME, world)


@pytest.mark.parametrize("how", ALONG)
def test_exact_junctions_give_the_exact_pose(how):
    rng = np.random.default_rng(3)
    gaps = []
    for _ in range(20):
        pose = random_pose(rng, how)
        poses = found_near(features_at(pose), roughly(pose, rng))
        assert len(poses)
        moved = np.abs(poses @ np.append(MIDDLE, 1.0) - pose @ np.append(MIDDLE, 1.0)).max(axis=1)
        gaps.append((np.abs(poses - pose).max(axis=(1, 2)) + moved).min())
    # A seen vertex may be nearer to a hidden one's corner, and poses where two solutions meet are
    # ill-defined.
    assert (np.array(gaps) < 1e-6).mean() >= 0.95


def test_noisy_junctions_give_about_the_pose_that_opencv_fits_to_all_vertices():
    rng = np.random.default_rng(5)
    gaps = []
    for _ in range(30):
        pose = random_pose(rng)
        features = features_at(pose, shifts=0.3 * rng.standard_normal((8, 2)))
        poses = found_near(features, roughly(pose, rng))
        matrix = np.array([[FOCAL, 0.0, CENTRE[0]], [0.0, FOCAL, CENTRE[1]], [0.0, 0.0, 1.0]])
        _, turn, shift = cv2.solvePnP(MODEL.vertices, features.corners, matrix, None)
        theirs = np.eye(4)
        theirs[:3, :3], theirs[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        apart = [
            seen(MODEL.vertices, solution) - seen(MODEL.vertices, theirs) for solution in poses
        ]
        gaps.append(min(np.sqrt((gap**2).sum(axis=1).mean()) for gap in apart))
    # Some px before; three points carry the noise of 0.3 px to the others about twofold.
    assert np.median(gaps) < 0.7
    assert np.quantile(gaps, 0.9) < 1.5


def test_a_junction_next_to_each_vertex_does_not_hide_the_vertex():
    rng = np.random.default_rng(6)
    gaps = []
    for _ in range(20):
        pose = random_pose(rng)
        features, rough = features_at(pose), roughly(pose, rng)
        displaced = features._replace(
            # Nearer to where the vertices are looked for than they are.
            corners=np.concatenate([seen(MODEL.vertices, rough) + 0.3, features.corners]),
            corner_segments=np.tile(features.corner_segments, (2, 1)),
        )
        gaps.append(np.abs(found_near(displaced, rough) - pose).max(axis=(1, 2)).min())
    assert (np.array(gaps) < 1e-6).mean() >= 0.9


def test_hidden_vertices_are_not_looked_for():
    pose = random_pose(np.random.default_rng(8))
    pose[:3, :3] = Rotation.from_euler("xyz", [0.7, 0.6, 0.3]).as_matrix()
    pose[:3, 3] = [0.0, 0.0, 5.0 * EXTENT] - pose[:3, :3] @ MIDDLE
    features = features_at(pose)
    # Three faces are seen, and of the eight vertices the farthest is on none of them.
    order = np.argsort(MODEL.vertices @ pose[2, :3])
    for chosen, any_found in ((order[:3], True), (order[[0, 1, 7]], False)):
        some = features._replace(
            corners=features.corners[chosen], corner_segments=features.corner_segments[chosen]
        )
        assert bool(len(found_near(some, pose))) == any_found


def test_what_is_found_is_near_and_of_a_bounded_number():
    rng = np.random.default_rng(7)
    for _ in range(20):
        pose = random_pose(rng)
        rough = roughly(pose, rng)
        poses = found_near(features_at(pose), rough)
        assert len(poses) <= 4 * MAX_TRIPLES * MAX_JUNCTIONS**3
        places = seen(MODEL.vertices, rough)
        extent = np.linalg.norm(np.ptp(places, axis=0))
        for solution in poses:
            moves = np.linalg.norm(seen(MODEL.vertices, solution) - places, axis=1)
            assert np.median(moves) < SEARCH_SHARE * extent
            np.testing.assert_allclose(solution[:3, :3] @ solution[:3, :3].T, np.eye(3), atol=1e-6)


def test_junctions_whose_segments_run_elsewhere_are_not_taken():
    rng = np.random.default_rng(9)
    pose = random_pose(rng, "face seen frontally")
    assert len(found_near(features_at(pose), pose))
    assert not len(found_near(features_at(pose, turn=np.pi / 4.0), pose))


def test_pictures_without_junctions_and_poses_behind_the_camera_give_nothing():
    rng = np.random.default_rng(11)
    pose = random_pose(rng)
    features = features_at(pose)
    alone = features._replace(corner_segments=np.full((len(features.corners), 4), -1))
    assert found_near(alone, pose).shape == (0, 4, 4)
    behind = pose.copy()
    behind[2, 3] -= 20.0 * EXTENT
    assert found_near(features, behind).shape == (0, 4, 4)
    # One vertex in the plane of the camera's centre, where nothing is projected.
    behind[2, 3] = pose[2, 3] - (MODEL.vertices[0] @ pose[2, :3] + pose[2, 3])
    assert found_near(features, behind).shape == (0, 4, 4)
    far = features._replace(corners=features.corners + 300.0)
    assert found_near(far, pose).shape == (0, 4, 4)


def test_of_many_vertices_a_part_of_all_triples_is_compared():
    assert vertex_triples(2).shape == (0, 3)
    assert len(vertex_triples(8)) == 56
    many = vertex_triples(60)
    assert len(many) == COMPARED_TRIPLES
    assert len({tuple(triple) for triple in many.tolist()}) == COMPARED_TRIPLES
    assert (np.unique(many[:, 0])[:50] == np.arange(50)).all()
