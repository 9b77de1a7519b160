"""A start that is given wrong is told from a rough one, and named for what it is."""

import numpy as np
import pytest
from jaxlie import SE3
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.staged.start_checks import start_doubts

CAMERA_LINK = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""ROS's camera_link from the optical frame."""


def scaled(pose, factor):
    pose = pose.copy()
    pose[:3, 3] *= factor
    return pose


def turned(pose, degrees):
    return host_exponentials(np.array([0, 0, 0, 0, 0, np.deg2rad(degrees)])) @ pose


def moved(pose, *metres):
    return host_exponentials(np.array([*metres, 0, 0, 0])) @ pose


def with_angles_in_radians(pose):
    """Yaw, pitch, roll written in radians and read as degrees."""
    pose = pose.copy()
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
    pose[:3, :3] = Rotation.from_euler("ZYX", np.deg2rad(angles)).as_matrix()
    return pose


def doubts(scene, camera=None, world=None):
    """The sentences about a start whose parts are made from the truth by functions."""
    truth, seen = scene.calibration, scene.calibration.camera_from_world(scene.base_from_tool)
    parts = zip(
        truth.transform_names,
        (camera, world),
        (truth.camera_from_mount, truth.holder_from_world),
        strict=True,
    )
    start = {
        name: host_transforms(change(host_matrices(pose))) for name, change, pose in parts if change
    }
    actual = start_doubts(start, truth, SE3(seen.wxyz_xyz), scene.data.visible, scene.data)
    return tuple(actual.values())


@pytest.mark.parametrize(
    "change", [lambda pose: pose, lambda pose: turned(moved(pose, 0.01, -0.02, 0.01), 8.0)]
)
def test_a_rough_start_is_not_doubted(scene, change):
    assert doubts(scene, change, change) == ()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (np.linalg.inv, "px if camera_from_tool and tool_from_camera were exchanged: invert it"),
        (lambda pose: scaled(pose, 1e3), "px if its lengths are millimetres: metres are expected"),
        (
            lambda pose: np.linalg.inv(scaled(pose, 1e3)),
            "were exchanged and its lengths are millimetres: invert it, in metres",
        ),
        (with_angles_in_radians, "px if its yaw, pitch, roll are radians: degrees are expected"),
        (lambda pose: CAMERA_LINK @ pose, "px if the camera's axes are x ahead, y left, z up"),
        (lambda pose: turned(pose, 90.0), "degrees from where the robot's"),
        (lambda pose: moved(pose, 0.3, 0.0, 0.0), "It is 300 mm and 0 degrees from where"),
    ],
)
def test_a_wrong_place_of_the_camera_is_named_for_what_it_is(scene, change, text):
    (doubt,) = doubts(scene, change)
    assert doubt.startswith("the start's camera_from_tool does not belong to these data: ")
    assert text in doubt


def test_a_wrong_place_of_the_target_is_named_for_what_it_is(scene):
    (doubt,) = doubts(scene, world=np.linalg.inv)
    assert "px if base_from_world and world_from_base were exchanged" in doubt
    (doubt,) = doubts(scene, world=lambda pose: scaled(pose, 1e2))
    assert "px if its lengths are centimetres" in doubt


def test_the_pose_of_a_view_is_recognised(scene):
    seen = host_matrices(scene.calibration.camera_from_world(scene.base_from_tool))
    (doubt,) = doubts(scene, lambda _: seen[3])
    assert doubt.endswith("it is the target's pose before the camera in view 3")
