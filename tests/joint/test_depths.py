"""A fit with depths at the points: the sensor's bias is found, printed and saved."""

import dataclasses

import numpy as np
import pytest
from depth_scene import NOISE, assert_bias_recovered, depth_scene

import smartview_jax as sv
from smartview_jax.engine import ParameterChoice
from smartview_jax.variance import with_weighed_depths

VIEWS = 16


@pytest.fixture(scope="module")
def scene():
    return depth_scene(4, VIEWS, translation_noise=1e-4)


@pytest.fixture(scope="module")
def fit(scene):
    """Everything estimated: lens, transforms, noises, and the sensor."""
    return sv.calibrate(scene.data.with_depths(scene.depths), "radial")


def test_the_bias_is_recovered(fit):
    sensor = fit.sensor
    assert_bias_recovered(sensor)
    assert sensor.scale == float(fit.calibration.depth_bias.scale)
    assert sensor.scale_std == pytest.approx(fit.std["depth_bias.scale"], rel=1e-6)
    assert sensor.along_growth == pytest.approx(NOISE.quadratic, rel=0.5)
    assert f"depth sensor: depths times {sensor.scale:.5f} +- " in str(fit)
    # These depths have no error in common: it is below the noise of their mean by the pixels.
    assert sensor.common_std < 3e-4
    assert not fit.warnings


def test_the_error_in_common_is_found():
    """Over some scenes, and the pixels tell it, not the robot."""
    stds = []
    for seed in range(4, 10):
        scene = depth_scene(seed, VIEWS, common=1e-3, translation_noise=1e-4)
        data = scene.data.with_depths(scene.depths)
        choice = ParameterChoice.of((), (), None)
        noise = with_weighed_depths(data, scene.truth, choice).depth_noise
        stds.append(noise.common)
    # The standard error of the mean is 1 / sqrt(2 * 6 * 14) of it, 8 %.
    assert np.sqrt(np.mean(np.square(stds))) == pytest.approx(1e-3, rel=0.3)


def test_a_depth_bias_is_saved_and_read_again(fit, tmp_path):
    fit.save(tmp_path / "camera.yaml")
    again = sv.load_estimate(tmp_path / "camera.yaml")
    assert again.sensor == fit.sensor
    assert again.parameter_names == fit.parameter_names
    assert float(again.calibration.depth_bias.offset) == fit.sensor.offset
    assert sv.Calibration.load(tmp_path / "camera.yaml").depth_bias is not None


def test_depths_of_another_unit_are_refused(scene):
    # Of a board that is seen from straight above, millimetres are not told by its tilt.
    data = scene.data.with_depths(scene.depths)
    depths = data.depths
    wrong = dataclasses.replace(depths, measured=3.0 * depths.measured)
    with pytest.raises(ValueError, match=r"depths: expected about 0\.2\d* m.*found 0\.6"):
        sv.fit_joint(dataclasses.replace(data, depths=wrong), scene.truth)
