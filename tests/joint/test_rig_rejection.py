"""A state that contradicts the others is left out, for the robot or for one camera alone."""

import dataclasses

import numpy as np
import pytest
from fit_scenes import scene_of
from jaxlie import SE3

from smartview_jax import Rig, fit_rig
from smartview_jax.simulation import paper_calibration

STATE = 4

CAMERAS = ("camera1", "camera2")


@pytest.fixture(scope="module")
def data():
    """The pictures of both cameras, which are in one place, in twelve states of the robot."""
    noise = {"translation_noise": 2e-5, "rotation_noise": 5e-5}
    return scene_of(2, 12, **noise).data


def fit(rig):
    """The rig's fit from the true calibrations."""
    return fit_rig(Rig(rig), dict.fromkeys(CAMERAS, paper_calibration()), field=None)


def moved(data, length):
    """The data with one reported pose moved along x, m."""
    poses = data.base_from_tool.wxyz_xyz.at[STATE, 4].add(length)
    return dataclasses.replace(data, base_from_tool=SE3(poses))


def test_a_pose_that_all_cameras_contradict_is_the_robots(data):
    found = fit(dict.fromkeys(CAMERAS, moved(data, 20e-3)))
    assert [(name, entry.view) for name, entry in found.rejected] == [
        ("camera1", "4"),
        ("camera2", "4"),
    ]
    assert "its pose contradicts the others" in found.rejected[0][1].reason
    assert found.noise.translation < 2e-4


def test_a_picture_that_one_camera_alone_contradicts_is_this_cameras(data):
    """The picture of the state is shifted by three pixels, as if the camera had been touched."""
    shifted = dataclasses.replace(data, pixels=data.pixels.at[STATE].add(3.0))
    found = fit({"camera1": data, "camera2": shifted})
    ((name, entry),) = found.rejected
    assert (name, entry.view) == ("camera2", "4")
    assert "contradicts the robot and camera1" in entry.reason


def test_a_good_rig_keeps_every_state(data):
    found = fit(dict.fromkeys(CAMERAS, data))
    assert found.rejected == ()
    assert np.isfinite(found.covariance).all()
