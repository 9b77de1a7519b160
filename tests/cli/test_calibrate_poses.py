"""`smartview calibrate` on tracked poses: a file of easy_handeye2, or a folder."""

import json

import numpy as np
import pytest
import yaml
from board_scene import run
from tracked_scene import MOUNT, tracked

from smartview_jax.calibration import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.dataset import DepthSensor, PoseDataset
from smartview_jax.geometry import as_se3, host_exponentials, host_matrices
from smartview_jax.io import (
    PoseSamples,
    poses_entry,
    save_dataset,
    write_easy_handeye,
    write_poses,
)
from smartview_jax.joint import load_estimate
from smartview_jax.simulation import simulate_depth_points

WRONG = 5


def pairs():
    robot, measured = tracked(3)
    measured[WRONG] = measured[WRONG] @ host_exponentials(np.array([0.1, 0, 0, 0.5, 0, 0]))
    return robot, measured


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("tracked")
    save_dataset(PoseDataset.from_poses(*pairs()), path)
    return path


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("out")


@pytest.fixture(scope="module")
def document(folder, out):
    ended = run("calibrate", folder, "--json", "--out", out)
    assert ended.exit_code == 0, ended.output
    return json.loads(ended.stdout)


def test_the_document_has_the_transform_both_noises_and_what_was_left_out(document):
    found = document["transforms"]["camera_from_tool"]
    np.testing.assert_allclose(found["translation"], MOUNT[:3, 3], atol=2e-3)
    assert document["camera"] is None
    assert [entry["view"] for entry in document["rejected"]] == [str(WRONG)]
    # A tracked pose of 0.5 mm per axis is 0.9 mm off; the held-out error has the fit's own too.
    assert 0.5 < document["fitted_rms"]["mm"] < document["held_out_rms"]["mm"] < 1.5
    assert document["tracker_std"]["mm"] == pytest.approx(0.5, rel=0.3)


def test_easy_handeye_publishes_the_transform(document, out):
    """Its publisher sends `transform` from the robot's frame to the tracker's."""
    content = yaml.safe_load((out / "hand_eye.calib").read_text())
    assert content["parameters"]["calibration_type"] == "eye_in_hand"
    assert content["parameters"]["robot_effector_frame"] == "tool0"
    translation = [content["transform"]["translation"][axis] for axis in "xyz"]
    expected = np.linalg.inv(MOUNT)[:3, 3]
    np.testing.assert_allclose(translation, expected, atol=3e-3)


def test_the_page_shows_every_pair(document, out):
    page = (out / "report.html").read_text()
    assert "held-out pairs, RMS" in page
    assert "from where the other pairs put it" in page
    assert "px" not in page.partition("<h1")[2].replace("px;", "").split("<img")[0]
    assert document["files"] == [str(out / name) for name in ("hand_eye.calib", "report.html")]


@pytest.fixture(scope="module")
def camera_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    camera = Camera(900.0, 900.0, 320.0, 240.0, Pinhole(), (640, 480))
    Calibration(camera, as_se3(np.eye(4)), as_se3(np.eye(4)), "eye_in_hand").save(path)
    return path


@pytest.fixture
def samples(tmp_path):
    robot, measured = pairs()
    path = tmp_path / "arm.samples"
    write_easy_handeye(path, PoseSamples(as_se3(robot), as_se3(measured), "eye_in_hand"))
    return path


def test_samples_of_easy_handeye_with_a_camera_give_a_calibration(samples, camera_file, tmp_path):
    ended = run(
        *("calibrate", samples, "--mount", "eye_in_hand", "--camera", camera_file),
        *("--no-held-out", "--out", tmp_path),
    )
    assert ended.exit_code == 0, ended.output
    assert "pair 5: not used:" in ended.output
    calibration = Calibration.load(tmp_path / "calibration.yaml")
    found = host_matrices(calibration.camera_from_tool)
    np.testing.assert_allclose(found[:3, 3], MOUNT[:3, 3], atol=2e-3)


def test_what_the_file_does_not_tell_is_asked(samples, folder):
    for words, message in {
        (samples,): "give --mount eye_in_hand",
        (folder, "--mount", "eye_in_hand"): "a data-set folder states its mount",
        (samples, "--mount", "eye_in_hand", "--time-offset"): "--time-offset: expected a data-set",
        (folder, "--diagnose"): "--diagnose: expected a data set with pictures",
    }.items():
        ended = run("calibrate", *words)
        assert ended.exit_code, ended.output
        assert message in " ".join(ended.output.split())


def test_other_subcommands_say_that_they_need_pictures(folder):
    ended = run("check", folder)
    assert ended.exit_code
    assert "only smartview calibrate takes it" in " ".join(ended.output.split())


def test_points_of_a_depth_sensor_give_the_transform_and_the_sensor(tmp_path, camera_file):
    robot, seen = tracked(2)
    y, x = np.mgrid[:4, :5]
    board = np.stack([0.02 * x, 0.02 * y, 0.0 * x], axis=-1).reshape(-1, 3)
    sensor = DepthSensor(1.02, 1e-3, 0.0, 0.0, 0.0, 1e-4, 2e-4)
    points = simulate_depth_points(seen, board, sensor, np.random.default_rng(0))
    (tmp_path / "points").mkdir()
    views = [str(view) for view in range(len(robot))]
    for view, own in zip(views, points, strict=True):
        np.save(tmp_path / "points" / f"{view}.npy", own)
    write_poses(tmp_path, views, as_se3(robot), "matrix")
    content = {
        "smartview_dataset": 1,
        "target": {"kind": "chessboard", "rows": 4, "columns": 5, "square": 0.02},
        "poses": poses_entry(len(views), "matrix"),
        "measured_points": {"pattern": "points/{view}.npy", "unit": "m"},
    }
    (tmp_path / "dataset.yaml").write_text(yaml.safe_dump(content))
    options = "--no-held-out", "--camera", camera_file, "--out", tmp_path / "out"
    ended = run("calibrate", tmp_path, *options)
    assert ended.exit_code == 0, ended.output
    said = " ".join(ended.output.split())
    assert "depth sensor: depths times 1.0" in said
    assert "noise of a measured point, along the ray" in said
    estimate = load_estimate(tmp_path / "out" / "calibration.yaml")
    found = host_matrices(estimate.calibration.camera_from_tool)
    np.testing.assert_allclose(found[:3, 3], MOUNT[:3, 3], atol=3e-3)
    assert estimate.sensor.scale == pytest.approx(1.02, abs=4.0 * estimate.sensor.scale_std)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "depth sensor" in page
    assert "Measured points" in page
