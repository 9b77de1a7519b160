"""The files that the library reads: how a good one is made, and what values may come out of it."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax import io
from smartview_jax.files import dump_yaml, read_yaml, write_atomically
from smartview_jax.geometry import ViewedRegion, host_exponentials, host_transforms
from smartview_jax.io import robot_cal_tools
from smartview_jax.io.folder_description import rough_pose
from smartview_jax.robot_errors import JointOffsets, LinearInPosition, RobotError
from smartview_jax.robots import kuka_lwr4
from smartview_jax.schemas.dataset import DATASET_SCHEMA
from smartview_jax.schemas.validation import validate_content
from smartview_jax.simulation import paper_calibration
from smartview_jax.targets import CircleGrid

from . import fuzz_meshes, fuzz_pictures
from .fuzz_formats_of_objects import (
    load_object_folder,
    misses_in_range,
    model_in_range,
    read_journal,
    read_touches,
    write_journal,
    write_misses,
    write_object,
    write_object_folder,
)
from .fuzz_numbers import NUMBERS
from .fuzz_text import ENCODINGS, TABLES, Mutation
from .fuzz_trees import TREES

FARTHEST = 100.0
"""Of a coordinate, m, and of a joint's reading, rad or m."""

_TARGET = CircleGrid(3, 4, 0.01)
_POSES = host_transforms(host_exponentials(np.random.default_rng(0).normal(scale=0.3, size=(3, 6))))


class Format(NamedTuple):
    """A kind of file.

    Attributes:
        write: a good one, with what belongs to it, to an empty folder; returns its path.
        read: as users do.
        refuse_out_of_range: raises AssertionError for values that no file may bring in.
        mutations: the mistakes that are made in it, by name.
    """

    write: Callable[[Path], Path]
    read: Callable[[Path], Any]
    refuse_out_of_range: Callable[[Any], None]
    mutations: Mapping[str, Mutation] = {**ENCODINGS, **NUMBERS, **TABLES, **TREES}


def _data(with_joints: bool) -> sv.Dataset:
    rng = np.random.default_rng(0)
    # Three views of the grid from the front: pixels that are no picture of it are refused.
    pixels = 100.0 + 3000.0 * _TARGET.points[:, :2] + rng.uniform(0.0, 200.0, (3, 1, 2))
    if not with_joints:
        return sv.Dataset.from_arrays(_TARGET.points, pixels, _POSES, (640, 480), target=_TARGET)
    joints = rng.uniform(-1.0, 1.0, (3, 7))
    return sv.Dataset.from_arrays(
        _TARGET.points, pixels, None, (640, 480), target=_TARGET, joints=joints, arm=kuka_lwr4()
    )


def _saved(name: str, with_joints: bool = False) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        sv.save_dataset(_data(with_joints), folder)
        return folder / name

    return write


def _roughly(mount: str, name: str, pose: dict[str, list[float]]) -> Callable[[Path], Path]:
    """A folder that also says roughly where its target is."""

    def write(folder: Path) -> Path:
        path = _saved("dataset.yaml")(folder)
        content = {**read_yaml(path), "mount": mount, name: pose}
        # The end mark stays the last entry.
        content["end"] = content.pop("end")
        return write_atomically(path, dump_yaml(content))

    return write


def _load_roughly(path: Path) -> tuple[sv.Dataset, SE3 | None]:
    whole = validate_content(read_yaml(path), DATASET_SCHEMA, path)
    return _load_folder(path), rough_pose(whole.base_from_world or whole.tool_from_world)


def _roughly_in_range(found: tuple[sv.Dataset, SE3 | None]) -> None:
    data, pose = found
    _data_in_range(data)
    if pose is not None:
        _poses_in_range(pose)


def _load_folder(path: Path) -> sv.Dataset:
    return sv.load_dataset(path.parent, keep_detections=False)


def _poses_in_range(poses: SE3) -> None:
    numbers = np.asarray(poses.wxyz_xyz).reshape(-1, 7)
    assert np.isfinite(numbers).all(), "a pose that is not finite"
    assert np.abs(np.linalg.norm(numbers[:, :4], axis=1) - 1.0).max() < 1e-5, "no rotation"
    # A file may have poses the other way round: their inverse is as far from the origin.
    assert np.linalg.norm(numbers[:, 4:], axis=1).max() <= 2.0 * FARTHEST, "a pose far away"


def _data_in_range(data: sv.Dataset) -> None:
    _poses_in_range(data.base_from_tool)
    assert min(data.image_size) >= 1, f"a picture of {data.image_size}"
    assert max(data.image_size) <= 100_000, f"a picture of {data.image_size}"
    assert len(set(data.view_ids)) == data.view_count > 0, "views without names of their own"
    seen = np.asarray(data.pixels)[np.asarray(data.visible)]
    assert ((seen >= -1.0) & (seen <= np.array(data.image_size))).all(), "a pixel far outside"
    points = np.asarray(data.points)
    assert (np.abs(points) <= 1e3 * FARTHEST).all(), "a target point far away"
    if data.joints is not None:
        assert (np.abs(np.asarray(data.joints)) <= FARTHEST).all(), "a reading far out"


def _calibration_in_range(found: sv.Calibration) -> None:
    _camera_in_range(found.camera)
    _poses_in_range(found.camera_from_mount)
    _poses_in_range(found.holder_from_world)
    assert 1e-3 <= float(found.target_scale) <= 1e3, f"target_scale {found.target_scale}"
    if found.region is not None:
        numbers = [found.region.plane_z, *found.region.centroid, found.region.radius]
        assert (np.abs(np.array(numbers)) <= 1e2 * FARTHEST).all(), "a region far away"
        near, far = map(float, found.region.distance_range)
        assert 0.0 < near <= far <= 1e2 * FARTHEST, f"distances {near} to {far}"
        assert float(found.region.side) in (-1.0, 0.0, 1.0), f"side {found.region.side}"
        lowest = float(found.region.min_tool_height)
        assert abs(lowest) <= 1e2 * FARTHEST or lowest == np.inf, f"lowest_tool {lowest}"
    if found.robot_error is not None:
        coefficients = np.asarray(found.robot_error.coefficients)
        assert (np.abs(coefficients) <= 1e4).all(), "a coefficient far out"
        moved = found.robot_error.field.names
        assert len(moved) == coefficients.size, "other coefficients than the field's"


def _camera_in_range(camera: sv.Camera) -> None:
    for name in ("alpha_u", "alpha_v"):
        assert 0.0 < float(getattr(camera, name)) <= 1e7, f"{name} {getattr(camera, name)}"
    for name in ("u0", "v0"):
        assert abs(float(getattr(camera, name))) <= 1e6, f"{name} {getattr(camera, name)}"
    assert all(abs(float(x)) <= 1e9 for x in vars(camera.lens).values()), "a lens far out"
    assert all(1 <= side <= 100_000 for side in camera.image_size), f"{camera.image_size}"


def _cameras_in_range(cameras: dict[str, sv.Camera]) -> None:
    for camera in cameras.values():
        _camera_in_range(camera)


def _calibration(with_arm: bool) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        field = LinearInPosition(jnp.array([0.4, 0.0, 0.3]), jnp.asarray(0.2))
        error = RobotError(field, 1e-3 * jnp.arange(18.0))
        if with_arm:
            error = RobotError(JointOffsets(kuka_lwr4()), 1e-3 * jnp.arange(7.0))
        cameras = np.array([[0.0, 0.1, 0.5], [0.2, 0.1, 0.7]])
        region = ViewedRegion.from_positions(cameras, _TARGET.points, cameras)
        found = dataclasses.replace(paper_calibration(), robot_error=error, region=region)
        found.save(folder / "calibration.yaml", "a run")
        return folder / "calibration.yaml"

    return write


def _samples(folder: Path) -> Path:
    path = folder / "arm.samples"
    io.write_easy_handeye(path, io.PoseSamples(_POSES, _POSES.inverse(), "eye_in_hand"))
    return path


def _samples_in_range(found: io.PoseSamples) -> None:
    _poses_in_range(found.base_from_tool)
    _poses_in_range(found.camera_from_world)


def _text(name: str, content: str) -> Callable[[Path], Path]:
    return lambda folder: write_atomically(folder / name, content)


def _matrix_rows(folder: Path) -> Path:
    io.write_matrix_rows(folder / "poses.txt", _POSES, "mm")
    return folder / "poses.txt"


def _visp_pose(folder: Path) -> Path:
    io.write_visp_pose(folder / "pose.yaml", SE3(_POSES.wxyz_xyz[0]))
    return folder / "pose.yaml"


def _viewpoints(name: str, pose_format: str = "val_oat") -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        joints = np.full((3, 6), 0.5)
        io.write_viewpoints(folder / name, _POSES, joints=joints, pose_format=pose_format)
        return folder / name

    return write


def _viewpoints_in_range(found: io.Viewpoints) -> None:
    _poses_in_range(found.base_from_tool)
    if found.joints is not None:
        assert np.isfinite(found.joints).all(), "a reading that is not finite"


def _pairs(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        columns = ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
        matrices = np.asarray(_POSES.as_matrix()).reshape(3, 16).tolist()
        rows = [",".join(map(repr, row)) for row in matrices]
        lines = [f"{view},{row}" for view, row in enumerate(rows)]
        write_atomically(folder / "poses.csv", "\n".join([f"view,{columns}", *lines]) + "\n")
        corners = [f"{view},0.0{k},0.1,0,1{k}.5,2{k}" for view in range(3) for k in range(4)]
        write_atomically(folder / "corners.csv", "\n".join(["view,X,Y,Z,u,v", *corners]) + "\n")
        return folder / name

    return write


def _import_pairs(path: Path) -> sv.Dataset:
    folder = path.parent
    return io.import_correspondences(folder / "poses.csv", folder / "corners.csv", (640, 480))


_QUATERNION = {"qx": 0.5, "qy": 0.5, "qz": -0.5, "qw": 0.5}
_POSE = dump_yaml({"x": 0.5, "y": 0.1, "z": 0.2, **_QUATERNION})
_CAL_DATA = dump_yaml({"a": [{"pose": f"p/{k}.yaml", "image": f"i/{k}.png"} for k in range(3)]})
_FINDER = {"type": "a::ModifiedCircleGridTargetFinder", "rows": 5, "cols": 6, "spacing": 0.02}
_POSITIONER = dump_yaml(
    {
        str(k): {
            "camera_joints": [],
            "pose": {"x": 0.5, "y": 0.1, "z": 0.2, **_QUATERNION},
            "target_joints": [0.1 * k, 0.2],
        }
        for k in range(3)
    }
)
_XML = """<?xml version="1.0"?>
<root><camera><name>c</name><image_width>640</image_width><image_height>480</image_height>
<model><u0>320.5</u0><v0>240.5</v0><px>607.5</px><py>606.5</py></model></camera></root>
"""
_URDF = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/>
<joint name="j1" type="revolute"><origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="0 0 1"/>
<parent link="base"/><child link="a"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="j2" type="prismatic"><origin xyz="0.2 0 0" rpy="0 1.5 0"/><axis xyz="0 1 0"/>
<parent link="a"/><child link="b"/><limit lower="0" upper="0.5" effort="1" velocity="1"/></joint>
</robot>
"""


def _entries_in_range(entries: Any) -> None:
    assert len(entries) > 0, "no views"


def _pose_in_range(row: np.ndarray) -> None:
    assert (np.abs(row) <= FARTHEST).all(), "a pose far out"


def _target_in_range(target: Any) -> None:
    assert np.abs(target.points).max() <= 1e3 * FARTHEST, "a target far out"


def _arm_in_range(arm: Any) -> None:
    numbers = np.concatenate([np.ravel(x) for x in (arm.theta, arm.d, arm.a, arm.alpha)])
    assert np.isfinite(numbers).all(), "an arm's number that is not finite"
    _poses_in_range(arm.flange_from_tool)
    _poses_in_range(arm.base_from_first)


def _positioner_in_range(found: Any) -> None:
    assert (np.abs(found[0]) <= FARTHEST).all(), "a reading far out"
    _poses_in_range(found[1])


def _log(name: str) -> Callable[[Path], Path]:
    """A data set whose robot logged its poses, with the times of the pictures in another table."""

    def write(folder: Path) -> Path:
        sv.save_dataset(_data(False), folder)
        poses = (folder / "poses.csv").read_text().splitlines()
        rows = [row.partition(",")[2] for row in poses if not row.startswith("#")]
        # A row every half second, and pictures at three of these times.
        times = [499.5 + 0.5 * k for k in range(len(rows))]
        logged = zip(times, [rows[1], *rows[1:]], strict=True)
        log = [f"time,{rows[0]}", *(f"{time},{row}" for time, row in logged)]
        names = [row.partition(",")[0] for row in poses[1:] if not row.startswith("#")]
        taken = [f"{name},{time}" for name, time in zip(names, times[1:], strict=True)]
        write_atomically(folder / "poses.csv", "\n".join([*log, ""]))
        write_atomically(folder / "times.csv", "\n".join(["view,time", *taken, ""]))
        content = read_yaml(folder / "dataset.yaml")
        content["poses"] |= {"picture_times": "times.csv", "time_offset": 0.0}
        content["poses"].pop("rows", None)
        content["end"] = content.pop("end")
        write_atomically(folder / "dataset.yaml", dump_yaml(content))
        return folder / name

    return write


_KALIBR = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n"


_CAMCHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.078, 0.0002, -0.0001]
  distortion_model: radtan
  intrinsics: [458.9, 457.6, 367.0, 249.3]
  resolution: [752, 480]
"""


_CAMERAMODEL = """{
    'lensmodel':  'LENSMODEL_OPENCV4',
    'intrinsics': [ 1761.2, 1761.3, 1965.7, 1087.5, -0.0127, 0.0359, -0.00025, 0.00053,],
    'imagersize': [ 4000, 2200,],
}
"""


def _opencv(folder: Path) -> Path:
    return write_atomically(folder / "camera.yaml", io.opencv_yaml(paper_calibration()))


FORMATS: dict[str, Format] = {
    "dataset": Format(_saved("dataset.yaml"), _load_folder, _data_in_range),
    "dataset of an arm": Format(_saved("dataset.yaml", True), _load_folder, _data_in_range),
    "dataset with angles": Format(
        _roughly(
            "eye_in_hand",
            "base_from_world",
            {"translation": [0.4, 0.0, 0.1], "yaw_pitch_roll_deg": [90.0, 0.0, 180.0]},
        ),
        _load_roughly,
        _roughly_in_range,
    ),
    "dataset with a quaternion": Format(
        _roughly(
            "eye_to_hand",
            "tool_from_world",
            {"translation": [0.4, 0.0, 0.1], "quaternion_wxyz": [0.5, 0.5, -0.5, 0.5]},
        ),
        _load_roughly,
        _roughly_in_range,
    ),
    "poses": Format(_saved("poses.csv"), _load_folder, _data_in_range),
    "detections": Format(_saved("detections.csv"), _load_folder, _data_in_range),
    "joints": Format(_saved("joints.csv", True), _load_folder, _data_in_range),
    "calibration": Format(_calibration(False), sv.Calibration.load, _calibration_in_range),
    "calibration of an arm": Format(_calibration(True), sv.Calibration.load, _calibration_in_range),
    "easy_handeye": Format(_samples, io.read_easy_handeye, _samples_in_range),
    "opencv": Format(_opencv, io.read_opencv_camera, _camera_in_range),
    "matrix rows": Format(
        _matrix_rows, lambda path: io.read_matrix_rows(path, "mm"), _poses_in_range
    ),
    "visp pose": Format(_visp_pose, io.read_visp_pose, _poses_in_range),
    "kalibr camera": Format(
        _text("camchain.yaml", _CAMCHAIN), io.read_kalibr_cameras, _cameras_in_range
    ),
    "mrcal camera": Format(
        _text("left.cameramodel", _CAMERAMODEL),
        io.read_mrcal_camera,
        _camera_in_range,
    ),
    "visp camera": Format(_text("camera.xml", _XML), io.read_visp_camera, _camera_in_range),
    "robot_cal_tools": Format(
        _text("cal_data.yaml", _CAL_DATA.replace("a:\n", "")),
        robot_cal_tools._read_entries,
        _entries_in_range,
    ),
    "robot_cal_tools pose": Format(
        _text("0.yaml", _POSE), robot_cal_tools._read_pose, _pose_in_range
    ),
    "robot_cal_tools target": Format(
        _text("target.yaml", dump_yaml({"target_finder": _FINDER})),
        robot_cal_tools._read_target,
        _target_in_range,
    ),
    "positioner": Format(
        _text("measured.yaml", _POSITIONER), io.read_robot_cal_kinematics, _positioner_in_range
    ),
    "viewpoints csv": Format(_viewpoints("v.csv"), io.read_viewpoints, _viewpoints_in_range),
    "viewpoints json": Format(_viewpoints("v.json"), io.read_viewpoints, _viewpoints_in_range),
    "viewpoints csv of KUKA": Format(
        _viewpoints("v.csv", "kuka_abc"), io.read_viewpoints, _viewpoints_in_range
    ),
    "viewpoints json of ABB": Format(
        _viewpoints("v.json", "abb"), io.read_viewpoints, _viewpoints_in_range
    ),
    "pairs, poses": Format(_pairs("poses.csv"), _import_pairs, _data_in_range),
    "pairs, corners": Format(_pairs("corners.csv"), _import_pairs, _data_in_range),
    "urdf": Format(_text("arm.urdf", _URDF), io.load_urdf, _arm_in_range),
    "pose log": Format(_log("poses.csv"), _load_folder, _data_in_range),
    "times of pictures": Format(_log("times.csv"), _load_folder, _data_in_range),
    "dataset with a log": Format(_log("dataset.yaml"), _load_folder, _data_in_range),
    "kalibr target": Format(_text("target.yaml", _KALIBR), io.read_april_grid, _target_in_range),
    "any camera": Format(_opencv, io.read_camera, _camera_in_range),
    "object": Format(write_object, io.load_object_model, model_in_range),
    "object's views": Format(
        write_object_folder, load_object_folder, lambda found: _poses_in_range(found.base_from_tool)
    ),
    "misses csv": Format(write_misses("misses.csv"), read_touches, misses_in_range),
    "misses yaml": Format(write_misses("misses.yaml"), read_touches, misses_in_range),
    "editor's journal": Format(write_journal, read_journal, lambda document: None),
    **{
        name: Format(write, fuzz_pictures.read, fuzz_pictures.in_range, mutations)
        for name, (write, mutations) in fuzz_pictures.PICTURES.items()
    },
    **{
        name: Format(write, io.read_mesh, fuzz_meshes.in_range, mutations)
        for name, (write, mutations) in fuzz_meshes.MESHES.items()
    },
}
