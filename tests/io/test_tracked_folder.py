"""Folders of tracked poses: what is saved is loaded, and what is wrong is named."""

import dataclasses

import numpy as np
import pytest
import yaml
from tracked_scene import tracked

import smartview_jax as sv
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.dataset import PoseDataset
from smartview_jax.geometry import host_matrices
from smartview_jax.io import read_folder_description, save_dataset

VIEWS = 5


@pytest.fixture
def data():
    robot, measured = tracked(0, views=VIEWS)
    measured[2] = np.nan
    return PoseDataset.from_poses(robot, measured, view_ids="abcde")


@pytest.fixture
def folder(data, tmp_path):
    save_dataset(data, tmp_path, "quaternion_xyzw")
    return tmp_path


def edit(folder, **entries):
    content = yaml.safe_load((folder / "dataset.yaml").read_text())
    for key, changes in entries.items():
        content[key] = content.get(key, {}) | changes
    (folder / "dataset.yaml").write_text(yaml.safe_dump(content, sort_keys=False))


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("pose_format", ["matrix", "kuka_abc"])
def test_what_is_saved_is_loaded(data, tmp_path, mount, pose_format):
    given = dataclasses.replace(data, mount=mount)
    save_dataset(given, tmp_path, pose_format)
    again = sv.load_dataset(tmp_path)
    assert isinstance(again, PoseDataset)
    assert (again.view_ids, again.mount) == (data.view_ids, mount)
    assert again.masked_views == (("c", "the target was not seen"),)
    np.testing.assert_array_equal(again.seen, data.seen)
    for name in ("base_from_tool", "camera_from_world"):
        read, written = (host_matrices(getattr(part, name))[data.seen] for part in (again, data))
        np.testing.assert_allclose(read, written, atol=1e-12)


@pytest.fixture
def with_covariances(data, tmp_path):
    roots = np.random.default_rng(1).normal(size=(VIEWS, 6, 6)) * [1e-3] * 6
    whole = roots @ roots.swapaxes(1, 2) + 1e-8 * np.eye(6)
    camera = Camera(600.0, 601.0, 320.0, 240.0, Pinhole(), (640, 480))
    stated = dataclasses.replace(data.with_covariance(whole), camera=camera)
    save_dataset(stated, tmp_path)
    return tmp_path, stated


def test_covariances_and_the_camera_are_saved(with_covariances):
    folder, stated = with_covariances
    again = sv.load_dataset(folder)
    assert again.states_covariance
    np.testing.assert_allclose(again.covariance, stated.covariance, rtol=1e-12)
    assert float(again.camera.alpha_v) == 601.0
    assert again.sensor is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\na,", "\nz,", "view 'z' has no pose"),
        ("\nb,", "\na,", "view a has more than one row"),
        ("cov_x_rx", "cov_rx_x", "missing cov_x_rx"),
        ("\na,", "\na,-", "view a: expected a symmetric, positive definite matrix"),
    ],
)
def test_wrong_covariances_are_named(with_covariances, old, new, message):
    folder, _ = with_covariances
    table = folder / "tracker_covariances.csv"
    table.write_text(table.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        sv.load_dataset(folder)


def test_a_view_without_covariance_is_named(with_covariances):
    folder, _ = with_covariances
    table = folder / "tracker_covariances.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:-1]))
    with pytest.raises(ValueError, match="truncated"):
        sv.load_dataset(folder)
    edit(folder, tracked_poses={"covariances": {"file": table.name}})
    with pytest.raises(ValueError, match="view e has no covariance"):
        sv.load_dataset(folder)


def test_inverse_poses_are_stated_by_their_direction(data, folder):
    edit(folder, tracked_poses={"direction": "world_from_camera"})
    read = host_matrices(sv.load_dataset(folder).camera_from_world)[data.seen]
    written = host_matrices(data.camera_from_world)[data.seen]
    np.testing.assert_allclose(read, np.linalg.inv(written), atol=1e-12)


def test_pairs_are_matched_by_name(data, folder):
    header, *rows = (folder / "tracker.csv").read_text().splitlines()
    (folder / "tracker.csv").write_text("\n".join([header, *rows[::-1]]) + "\n")
    read = sv.load_dataset(folder)
    np.testing.assert_allclose(
        host_matrices(read.camera_from_world)[data.seen],
        host_matrices(data.camera_from_world)[data.seen],
        atol=1e-12,
    )


def test_a_wrong_pose_is_an_error_or_a_masked_view(folder):
    text = (folder / "tracker.csv").read_text().splitlines()
    name, *numbers = text[2].split(",")
    text[2] = ",".join([name, *numbers[:3], "3.0", *numbers[4:]])
    (folder / "tracker.csv").write_text("\n".join(text) + "\n")
    with pytest.raises(ValueError, match=r"tracker\.csv: quaternion_xyzw: row b"):
        sv.load_dataset(folder)
    masked = dict(sv.load_dataset(folder, bad_views="mask").masked_views)
    assert masked.keys() == {"b", "c"}
    assert "quaternion_xyzw" in masked["b"]


CASES = {
    "unknown view": (("tracker.csv", "\na,", "\nz,"), "tracker.csv: view z: the robot's table"),
    "no direction": (
        ("dataset.yaml", "  direction: camera_from_world\n", ""),
        "'tracked_poses.direction' is missing",
    ),
    "robot's direction": (
        ("dataset.yaml", "camera_from_world", "base_from_tool"),
        "tracked_poses.direction is one of camera_from_world",
    ),
    "cut": (("dataset.yaml", "rows: 4", "rows: 5"), "tracker.csv"),
    "target": (
        ("dataset.yaml", "mount:", "camera: {image_size: [640, 480]}\nmount:"),
        "camera: a data set of tracked_poses has none",
    ),
    "no unit": (
        (
            "dataset.yaml",
            "  length_unit: m\n  angle_unit: rad\n  direction: camera",
            "  direction: camera",
        ),
        "entry 'tracked_poses.length_unit'",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_errors_name_what_is_wrong(folder, case):
    (file, old, new), message = CASES[case]
    edit(folder)  # one entry a line
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        sv.load_dataset(folder)


def test_what_needs_pictures_says_so(folder):
    with pytest.raises(ValueError, match="expected a data set with pictures of a target"):
        read_folder_description(folder)
    with pytest.raises(TypeError, match="fit_poses"):
        sv.calibrate(sv.load_dataset(folder))
