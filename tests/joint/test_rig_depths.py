"""A rig in which one camera measures depths: its sensor's bias is found with all else."""

import numpy as np
import pytest
from depth_scene import assert_bias_recovered, depth_scene
from starts import nudged

import smartview_jax as sv
from smartview_jax.simulation import paper_calibration

NOISE = sv.Noise(0.15, 1e-4, 2e-4)
"""Noise of the scene below, as stated."""


@pytest.fixture(scope="module")
def scene():
    return depth_scene(4, 16, translation_noise=1e-4)


@pytest.fixture(scope="module")
def fit(scene):
    """Two cameras at one place, everything estimated but smooth errors of the robot.

    These and depths together are fitted for one camera in `test_depths`.
    """
    data = scene.data.with_depths(scene.depths)
    return sv.calibrate(sv.Rig({"left": data, "right": scene.data}), "radial", field=None)


def test_one_camera_with_depths_is_fitted_as_alone(scene):
    data, start = scene.data.with_depths(scene.depths), nudged(paper_calibration())
    alone = sv.fit_joint(data, start, noise=NOISE)
    rig = sv.fit_rig(sv.Rig({"only": data}), {"only": start}, noise=NOISE)
    assert rig.solution.costs[-1] == pytest.approx(alone.solution.costs[-1], rel=1e-12)
    np.testing.assert_allclose(rig.covariance, alone.covariance, rtol=1e-4, atol=1e-14)
    sensor = rig.estimate("only").sensor
    assert sensor.scale == pytest.approx(alone.sensor.scale, abs=1e-10)
    assert sensor.scale_std == pytest.approx(alone.sensor.scale_std, rel=1e-6)
    assert sensor.common_std == alone.sensor.common_std


def test_the_bias_is_recovered(fit):
    assert list(fit.sensors) == ["left"]
    assert fit.calibrations["right"].depth_bias is None
    sensor = fit.sensors["left"]
    assert_bias_recovered(sensor)
    # Depths count by the pixels' noise; with a wrong weight both cameras' noise is off.
    assert fit.pixel_sigmas["left"] == pytest.approx(0.15, rel=0.05)
    assert fit.pixel_sigmas["right"] == pytest.approx(0.15, rel=0.05)
    assert f"depth sensor: depths times {sensor.scale:.5f} +- " in str(fit)


def test_a_rig_with_depths_is_saved_and_read_again(fit, tmp_path):
    fit.save(tmp_path)
    again = sv.load_rig_estimate(tmp_path)
    assert float(again.calibrations["left"].depth_bias.offset) == fit.sensors["left"].offset
    assert again.parameter_names == fit.parameter_names
    assert sv.load_estimate(tmp_path / "left.yaml").sensor == fit.sensors["left"]


def test_a_bias_is_held_or_has_a_prior_by_the_cameras_name(scene):
    data, start = scene.data.with_depths(scene.depths), paper_calibration()
    rig, starts = sv.Rig({"left": data}), {"left": start}
    held = sv.fit_rig(rig, starts, noise=NOISE, fixed=("left.depth_bias",))
    assert (held.sensors["left"].scale, held.sensors["left"].scale_std) == (1.0, 0.0)
    prior = {"left.depth_bias.scale": sv.Prior(std=1e-6, mean=1.01)}
    near = sv.fit_rig(rig, starts, noise=NOISE, priors=prior)
    assert near.sensors["left"].scale == pytest.approx(1.01, abs=1e-5)
