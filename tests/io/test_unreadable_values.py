"""Values that no reader accepts are refused by the writers, before anything is written."""

import equinox as eqx
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.io import (
    PoseSamples,
    opencv_yaml,
    ros_camera_info,
    write_dataset_folder,
    write_easy_handeye,
    write_new_dataset,
    write_object_views,
    write_viewpoints,
    write_visp_pose,
)
from smartview_jax.robots import kuka_lwr4
from smartview_jax.simulation import paper_calibration
from smartview_jax.targets import CircleGrid

TARGET = CircleGrid(3, 4, 0.01)
FAR = SE3.from_translation(np.array([[0.0, 0.0, 200.0], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]))
NEAR = SE3.from_translation(np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]))
VIEWS = ("a", "b", "c")
PICTURES = [np.zeros((12, 16), np.uint8)] * 3


def camera_of_nothing():
    camera = Camera(800.0, 800.0, 2e9, 240.0, Pinhole(), (640, 480))
    return eqx.tree_at(lambda cal: cal.camera, paper_calibration(), camera)


def joints_of_no_arm(folder):
    joints = np.full((3, 7), 500.0)
    arm = kuka_lwr4()
    write_object_views(folder, VIEWS, PICTURES, arm.command(joints), arm=arm)


REFUSALS = r"not written|given as metres|rad or m, more than|not readable as YAML"
WRITERS = {
    "data set": lambda folder: write_dataset_folder(
        folder, VIEWS, FAR, (9, 9), TARGET, "eye_in_hand"
    ),
    "mount": lambda folder: write_dataset_folder(folder, VIEWS, NEAR, (9, 9), TARGET, "ceiling"),
    "size": lambda folder: write_dataset_folder(folder, VIEWS, NEAR, (0, 9), TARGET, "eye_in_hand"),
    "object views": lambda folder: write_object_views(folder, VIEWS, PICTURES, FAR),
    "suffix": lambda folder: write_object_views(folder, VIEWS, PICTURES, NEAR, suffix=".{png}"),
    "joints": joints_of_no_arm,
    "viewpoints": lambda folder: write_viewpoints(
        folder / "v.json", NEAR, VIEWS, np.full((3, 7), 500.0)
    ),
    "easy_handeye": lambda folder: write_easy_handeye(
        folder / "x.samples", PoseSamples(FAR, NEAR, "eye_in_hand")
    ),
    "visp": lambda folder: write_visp_pose(
        folder / "pose.yaml", SE3.from_translation(np.array([0.0, 0.0, 200.0]))
    ),
    "new data set": lambda folder: write_new_dataset(
        folder, "ur", "charuco", "eye_in_hand", (640, 480), '.png"}'
    ),
    "ros": lambda folder: ros_camera_info(camera_of_nothing()),
    "opencv": lambda folder: opencv_yaml(camera_of_nothing()),
    "calibration": lambda folder: camera_of_nothing().save(folder / "c.yaml"),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_what_could_not_be_read_back_is_not_written(tmp_path, writer):
    with pytest.raises(ValueError, match=REFUSALS):
        WRITERS[writer](tmp_path)
    assert not list(tmp_path.rglob("*.*")), writer
