"""What views of a camera with a depth sensor tell about it, against the bounds of such views."""

import dataclasses

import jax
import numpy as np
import pytest
from depth_scene import depth_scene

from smartview_jax import Noise, Rig, cramer_rao
from smartview_jax.calibration import DepthBias
from smartview_jax.dataset import DepthNoise
from smartview_jax.geometry import host_matrices
from smartview_jax.viewpoints import InformationModel, RigInformationModel

NOISE = Noise(0.15, 1e-4, 1e-4)
SENSOR = DepthNoise(2e-4, 2e-3, 1e-3)


@pytest.fixture(scope="module")
def scene():
    """Calibration, poses of the cameras, and their views of the whole target, with exact depths."""
    plain = depth_scene(0)
    truth = dataclasses.replace(plain.truth, depth_bias=DepthBias())
    whole = np.flatnonzero(np.asarray(plain.data.visible).all(axis=1))
    data = plain.data.select(whole)
    poses = truth.camera_from_world(data.base_from_tool)
    matrices, points = host_matrices(poses), np.asarray(data.points)
    depths = np.einsum("vi,vni->vn", matrices[:, 2, :3], points) + matrices[:, 2, 3:]
    return truth, poses, data.with_depths(depths, SENSOR)


def std_of(matrix):
    return np.sqrt(np.diagonal(np.linalg.inv(matrix)))


def test_views_so_far_tell_what_their_bound_says(scene):
    truth, _, data = scene
    points = np.asarray(data.points)[0]
    for noise in (NOISE, 0.15):
        bound = cramer_rao(truth, data, noise)
        model = InformationModel.from_calibration(truth, points, noise, previous_data=data)
        assert model.parameter_names == bound.parameter_names
        assert "depth_bias.scale" in model.parameter_names
        told = std_of(np.asarray(model.prior_information))
        np.testing.assert_allclose(told, list(bound.std.values()), rtol=1e-6)


def test_planned_views_have_depths(scene):
    truth, poses, data = scene
    points = np.asarray(data.points)[0]
    model = InformationModel.from_calibration(truth, points, NOISE, depth_noise=SENSOR)
    expected, seen = model.information(poses), model.dataset_information(data)
    np.testing.assert_array_equal(model.expected_observations(poses).visible, data.visible)
    np.testing.assert_allclose(expected, seen, rtol=1e-9, atol=1e-9 * np.abs(seen).max())
    # The same inside a program.
    traced = jax.jit(lambda p: model.information(p))(poses)
    np.testing.assert_allclose(traced, expected, rtol=1e-6, atol=1e-9 * np.abs(seen).max())


def test_a_camera_without_a_sensor_tells_less_and_pixels_are_counted_alike(scene):
    truth, poses, data = scene
    points = np.asarray(data.points)[0]
    plain = InformationModel.from_calibration(truth, points, NOISE)
    model = InformationModel.from_calibration(truth, points, NOISE, depth_noise=SENSOR)
    shared = [model.parameter_names.index(name) for name in plain.parameter_names]
    without = np.asarray(plain.dataset_information(data)).sum(axis=0)
    # Of the sensor's bias as much is known as before any view.
    told = np.asarray(model.prior_information + model.information(poses).sum(axis=0))
    better = std_of(told)[shared] / std_of(without)
    assert better.max() < 1.0 + 1e-9
    assert better.min() < 0.7
    moments = np.asarray(model.pixel_moment_matrix(poses))
    np.testing.assert_array_equal(moments[np.ix_(shared, shared)], plain.pixel_moment_matrix(poses))
    assert np.count_nonzero(moments) == np.count_nonzero(plain.pixel_moment_matrix(poses))


def test_states_of_a_rig_have_the_depths_of_its_cameras(scene):
    truth, _, data = scene
    plain = dataclasses.replace(truth, depth_bias=None)
    calibrations = {"left": truth, "right": plain}
    rig = Rig({"left": data, "right": data.with_depths(None)})
    model = RigInformationModel.from_calibrations(calibrations, rig, NOISE)
    planned = model.planned(data.base_from_tool)
    expected, seen = np.asarray(model.information(planned)), np.asarray(model.information(rig))
    np.testing.assert_allclose(expected, seen, rtol=1e-7, atol=1e-9 * np.abs(seen).max())
    bound = cramer_rao(calibrations, rig, NOISE)
    told = std_of(np.asarray(model.prior_information) + seen.sum(axis=0))
    np.testing.assert_allclose(told, list(bound.std.values()), rtol=1e-6)
    of_pixels = np.asarray(model.pixel_moment_matrix(rig))
    bias = [k for k, name in enumerate(model.parameter_names) if "depth_bias" in name]
    assert bias
    assert not of_pixels[bias].any()
