"""Folders of a depth sensor: points and depth pictures become poses, and what is wrong is named."""

import cv2
import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.calibration import Calibration
from smartview_jax.cameras import Camera, OpenCV4
from smartview_jax.dataset import DepthSensor
from smartview_jax.geometry import as_se3, host_exponentials
from smartview_jax.io import poses_entry, save_dataset, write_poses
from smartview_jax.simulation import render, simulate_depth_points
from smartview_jax.targets import Chessboard, target_to_dict

BOARD = Chessboard(5, 4, 0.02)
TARGET = np.asarray(BOARD.points)
VIEWS = "abcde"
CAMERA_FROM_TOOL = host_exponentials(np.array([0.02, -0.05, 0.08, 0.1, -0.1, 1.5]))
BASE_FROM_WORLD = host_exponentials(np.array([0.6, 0.1, 0.0, 0.0, 0.0, 0.4]))
SENSOR = DepthSensor(1.0, 0.0, 0.0, 0.0, 0.0, 1e-5, 2e-5)


def poses():
    """The target before the sensor, and the robot that brings it there."""
    rng = np.random.default_rng(0)
    seen = np.tile(np.eye(4), (len(VIEWS), 1, 1))
    turns = rng.normal(size=(len(VIEWS), 3)) * [0.35, 0.35, 0.5]
    seen[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    seen[:, :3, 3] = [-0.03, -0.03, 0.0] + np.linspace(0.25, 0.4, len(VIEWS))[:, None] * [0, 0, 1]
    return seen, BASE_FROM_WORLD @ np.linalg.inv(seen) @ CAMERA_FROM_TOOL


def describe(folder, robot, **entries):
    """Write the robot's table and the description."""
    write_poses(folder, list(VIEWS), as_se3(robot), "matrix")
    content = {
        "smartview_dataset": 1,
        "target": target_to_dict(BOARD),
        "poses": poses_entry(len(VIEWS), "matrix"),
        **entries,
    }
    (folder / "dataset.yaml").write_text(yaml.safe_dump(content))


def write_points(path, points):
    """Points in mm, in the format of the name."""
    points = 1e3 * points
    if path.suffix == ".csv":
        seen = np.flatnonzero(np.isfinite(points[:, 0]))
        rows = [f"{k},{','.join(map(repr, points[k].tolist()))}" for k in seen]
        path.write_text("\n".join(["point,x,y,z", *rows]) + "\n")
    elif path.suffix == ".npy":
        np.save(path, points)
    elif path.suffix == ".npz":
        np.savez(path, points=points)
    else:
        trimesh.PointCloud(points).export(path)


@pytest.fixture
def measured():
    seen, robot = poses()
    points = simulate_depth_points(seen, TARGET, SENSOR, np.random.default_rng(1))
    return robot, points


def points_folder(folder, measured, suffix=".csv", unit="mm"):
    robot, points = measured
    (folder / "points").mkdir()
    for view, own in zip(VIEWS, points, strict=True):
        write_points(folder / "points" / f"{view}{suffix}", own)
    describe(folder, robot, measured_points={"pattern": f"points/{{view}}{suffix}", "unit": unit})
    return folder


@pytest.mark.parametrize(
    ("suffix", "unit"), [(".csv", "mm"), (".npy", 0.001), (".npz", "mm"), (".ply", "mm")]
)
def test_points_become_poses(tmp_path, measured, suffix, unit):
    _, points = measured
    data = sv.load_dataset(points_folder(tmp_path, measured, suffix, unit))
    expected = sv.depth.poses_from_points(points, TARGET)
    # PLY files have single precision.
    np.testing.assert_allclose(data.tracked_matrices, expected.camera_from_world, atol=1e-6)
    np.testing.assert_allclose(data.covariance, expected.covariance, rtol=0.02, atol=1e-12)
    assert data.sensor.scale == pytest.approx(expected.sensor.scale, abs=1e-6)
    assert data.view_ids == tuple(VIEWS)
    # Poses are saved with their covariances, and the sensor.
    save_dataset(data, tmp_path / "again")
    again = sv.load_dataset(tmp_path / "again")
    assert again.sensor == data.sensor
    for name in ("covariance", "sensor_changes", "point_rms"):
        np.testing.assert_allclose(getattr(again, name), getattr(data, name), rtol=1e-12)
    np.testing.assert_allclose(again.tracked_matrices, data.tracked_matrices, atol=1e-12)


def test_depth_pictures_become_poses(tmp_path):
    seen, robot = poses()
    camera = Camera(400.0, 402.0, 160.0, 120.0, OpenCV4(0.05, -0.02, 1e-3, -1e-3), (320, 240))
    calibration = Calibration(
        camera, as_se3(CAMERA_FROM_TOOL), as_se3(BASE_FROM_WORLD), "eye_in_hand"
    )
    calibration.save(tmp_path / "camera.yaml")
    rows, columns = np.mgrid[:240, :320].astype(float)
    rays = np.asarray(camera.unproject(np.stack([columns, rows], axis=-1))[0])
    for name in ("grey", "depth"):
        (tmp_path / name).mkdir()
    for view, own, pose in zip(VIEWS, robot, seen, strict=True):
        picture = render(calibration, as_se3(own), BOARD, samples=2)
        cv2.imwrite(str(tmp_path / "grey" / f"{view}.png"), picture)
        normal = pose[:3, 2]
        depth = normal @ pose[:3, 3] / (rays @ normal) * rays[..., 2]
        numbers = np.round(1e4 * depth).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "depth" / f"{view}.png"), numbers)
    describe(
        tmp_path,
        robot,
        camera={"image_size": [320, 240]},
        pictures={"pattern": "grey/{view}.png"},
        depth_pictures={"pattern": "depth/{view}.png", "unit": 1e-4, "camera": "camera.yaml"},
    )
    data = sv.load_dataset(tmp_path)
    assert data.seen.all()
    assert data.camera.image_size == (320, 240)
    np.testing.assert_allclose(data.tracked_matrices[:, :3, 3], seen[:, :3, 3], atol=1e-3)
    np.testing.assert_allclose(data.tracked_matrices[:, :3, :3], seen[:, :3, :3], atol=0.02)
    # Without the camera its lens is to be found: depths count together with the pixels.
    description = tmp_path / "dataset.yaml"
    content = yaml.safe_load(description.read_text())
    together = {**content["depth_pictures"], "noise": {"constant": 1e-4}}
    content["depth_pictures"] = together
    description.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match="noise: it is estimated where the camera is known"):
        sv.load_dataset(tmp_path)
    camera_file = together.pop("camera")
    description.write_text(yaml.safe_dump(content))
    pixels = sv.load_dataset(tmp_path)
    assert pixels.depth_noise.constant == 1e-4
    expected = seen[:, 2, :3] @ TARGET.T + seen[:, 2, 3, None]
    used = pixels.depths.used
    assert used.mean() > 0.9
    np.testing.assert_allclose(np.asarray(pixels.depths.measured)[used], expected[used], atol=3e-4)
    del together["noise"]
    description.write_text(
        yaml.safe_dump({**content, "depth_pictures": {**together, "camera": camera_file}})
    )
    # A depth picture of another size is the file's mistake.
    cv2.imwrite(str(tmp_path / "depth" / "c.png"), np.full((120, 160), 3000, np.uint16))
    with pytest.raises(ValueError, match=r"c\.png: depth: expected 320 x 240 px.*found 160 x 120"):
        sv.load_dataset(tmp_path)
    masked = dict(sv.load_dataset(tmp_path, bad_views="mask").masked_views)
    assert masked.keys() == {"c"}
    assert "found 160 x 120" in masked["c"]


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("points/b.csv", "\n3,", "\n99,", r"b\.csv: row \d: the target has no point 99"),
        ("points/b.csv", "\n3,", "\n4,", r"b\.csv: row \d: point 4 has more than one row"),
        ("points/b.csv", "\n3,", "\n3,x", r"b\.csv: view row \d: x is .* not a number"),
        ("points/b.csv", "point,x", "x,point", r"b\.csv: row 1: the target has no point -"),
        ("dataset.yaml", "unit: mm", "unit: inch", "measured_points.unit"),
        ("dataset.yaml", "unit: mm", "unit: m", r"dataset\.yaml: .*the target seems .* times its"),
        ("dataset.yaml", "{view}.csv", "{view}.txt", r"a\.txt: no such file of points"),
        ("dataset.yaml", "target:", "camera: {image_size: [9, 9]}\ntarget:", "camera: a data set"),
    ],
)
def test_wrong_files_are_named(tmp_path, measured, file, old, new, message):
    points_folder(tmp_path, measured)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        sv.load_dataset(tmp_path)


def test_wrong_arrays_are_named_or_mask_their_view(tmp_path, measured):
    folder = points_folder(tmp_path, measured, ".npy")
    points = np.load(folder / "points" / "b.npy")
    for wrong, message in (
        (points[:-1], r"b\.npy: expected 20 points of the target, .* found shape \(19, 3\)"),
        (-points, r"b\.npy: point \d+: expected a depth z above 0, found .* no row, or nan"),
        (np.array([{}]), r"b\.npy: no readable points"),
    ):
        np.save(folder / "points" / "b.npy", wrong)
        with pytest.raises(ValueError, match=message):
            sv.load_dataset(folder)
        masked = dict(sv.load_dataset(folder, bad_views="mask").masked_views)
        assert masked.keys() == {"b"}
