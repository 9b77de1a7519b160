"""A state that contradicts the others is left out, for the robot or for one camera alone."""

import dataclasses

import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Rig, fit_rig
from smartview_jax.simulation import six_axis_rig_scene

STATE = 4


@pytest.fixture(scope="module")
def scene():
    """A stereo head that sees the board in twelve states, on an arm with noise alone."""
    return six_axis_rig_scene(2, 2, 12, together=True, error_scale=0.0)


def starts_of(scene):
    """The true calibrations, without the arm's errors."""
    return {name: truth.uncorrected for name, truth in scene.calibrations.items()}


def moved(data, length):
    """The data with one reported pose moved along x, m."""
    poses = data.base_from_tool.wxyz_xyz.at[STATE, 4].add(length)
    return dataclasses.replace(data, base_from_tool=SE3(poses))


def test_a_pose_that_all_cameras_contradict_is_the_robots(scene):
    rig = Rig({name: moved(data, 20e-3) for name, data in scene.rig.cameras.items()})
    fit = fit_rig(rig, starts_of(scene), field=None)
    assert [(name, entry.view) for name, entry in fit.rejected] == [
        ("camera1", "4"),
        ("camera2", "4"),
    ]
    assert "its pose contradicts the others" in fit.rejected[0][1].reason
    assert fit.noise.translation < 2e-4


def test_a_picture_that_one_camera_alone_contradicts_is_this_cameras(scene):
    """The picture of the state is shifted by three pixels, as if the camera had been touched."""
    data = scene.rig.cameras["camera2"]
    shifted = dataclasses.replace(data, pixels=data.pixels.at[STATE].add(3.0))
    fit = fit_rig(
        Rig({"camera1": scene.rig.cameras["camera1"], "camera2": shifted}),
        starts_of(scene),
        field=None,
    )
    ((name, entry),) = fit.rejected
    assert (name, entry.view) == ("camera2", "4")
    assert "contradicts the robot and camera1" in entry.reason


def test_a_good_rig_keeps_every_state(scene):
    fit = fit_rig(scene.rig, starts_of(scene), field=None)
    assert fit.rejected == ()
    assert np.isfinite(fit.covariance).all()
