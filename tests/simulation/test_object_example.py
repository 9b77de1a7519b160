import json

import numpy as np
import pytest
import trimesh

from smartview_jax import features
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_dataset, load_object_views, object_sample_folder
from smartview_jax.simulation import example_solid, object_example_boards

pytest.importorskip("embreex")

RENDERED = (0, 3)
"""Which of the example's pictures are rendered; see `conftest`."""


@pytest.fixture(scope="module")
def sample():
    return load_object_views(object_sample_folder() / "object")


def test_the_packages_sample_is_this_example(example, sample):
    """As JPEG: grey levels differ a little, poses do not."""
    assert len(sample.pictures) == len(example.pictures) == 5
    for k in RENDERED:
        difference = sample.pictures[k].astype(float) - example.pictures[k]
        assert np.abs(difference).mean() < 2.0
        assert abs(difference.mean()) < 0.1
    stored, reported = host_matrices(sample.base_from_tool), host_matrices(example.reported)
    np.testing.assert_allclose(stored, reported, atol=1e-12)
    truth = json.loads((object_sample_folder() / "truth.json").read_text())
    np.testing.assert_allclose(truth["vertices"], example.solid.vertices, atol=1e-12)
    assert [tuple(face) for face in truth["faces"]] == list(example.solid.faces)


def test_the_five_viewpoints_are_steps_of_nine_and_a_half_degrees(example):
    camera_from_world = host_matrices(example.calibration.camera_from_world(example.base_from_tool))
    axes = camera_from_world[:, 2, :3]
    angles = np.rad2deg(np.arccos(axes[1:] @ axes[0]))
    np.testing.assert_allclose(angles, 9.5, atol=1e-6)


def test_visible_vertices_are_corners_of_the_pictures(example):
    """Vertices on lit faces: those that trimesh says are seen, away from the shadow's side."""
    solid, calibration = example.solid, example.calibration
    mesh = trimesh.Trimesh(solid.vertices, solid.triangles, process=False)
    poses = host_matrices(example.base_from_tool)
    gaps = []
    for picture, pose in ((example.pictures[k], poses[k]) for k in RENDERED):
        camera_from_world = host_matrices(calibration.camera_from_world(pose))
        centre = np.linalg.inv(camera_from_world)[:3, 3]
        # A vertex is seen if the way to the camera from just above it is free.
        towards = centre - solid.vertices
        starts = solid.vertices + 1e-5 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
        seen = ~mesh.ray.intersects_any(starts, towards)
        in_picture = features.find(picture, calibration.camera)
        pixels = np.asarray(calibration.project(pose, solid.vertices)[0])
        gaps += list(np.linalg.norm(in_picture.corners[:, None] - pixels[seen], axis=2).min(axis=0))
    assert len(gaps) > 16
    # The others lie where two faces are equally bright.
    assert np.mean(np.array(gaps) < 1.5) > 0.75
    assert np.median(gaps) < 0.3


def test_the_board_calibrates_the_rig():
    data = load_dataset(object_sample_folder(), keep_detections=False)
    boards = object_example_boards()
    np.testing.assert_allclose(
        host_matrices(data.base_from_tool), host_matrices(boards.reported), atol=1e-12
    )
    predicted = np.asarray(boards.calibration.project(boards.base_from_tool, data.points[0])[0])
    seen = np.asarray(data.visible)
    assert seen.mean() > 0.9
    error = np.linalg.norm(np.asarray(data.pixels) - predicted, axis=-1)[seen]
    assert np.sqrt(np.mean(error**2)) < 0.2


def test_the_object_stands_on_the_board():
    solid = example_solid()
    assert solid.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-15)
    assert trimesh.Trimesh(solid.vertices, solid.triangles, process=False).is_volume
