"""What was held, or given by a prior, is asked of the pictures, and a contradiction is named."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS
from starts import nudged

from smartview_jax import Noise, Prior, fit_joint
from smartview_jax.cameras import Camera, Pinhole, Radial
from smartview_jax.engine import STEP_NAMES
from smartview_jax.simulation import paper_calibration, random_scene

NOISE = Noise(0.15, 1e-4, float(np.deg2rad(0.01)))
"""Of the scenes; a fit that is given it has fewer programs to compile."""


def wide_scene(k1):
    """A camera with a wide lens, and a board of 0.24 by 0.16 m that fills its picture."""
    y, x = np.indices((2, 7)).reshape(2, -1)
    board = np.stack([0.04 * x, 0.16 * y, np.zeros(14)], axis=1)
    camera = Camera(500.0, 500.0, 320.0, 240.0, Radial(k1), (640, 480))
    return random_scene(
        0,
        MANY_VIEWS,
        board,
        dataclasses.replace(paper_calibration(), camera=camera),
        distance=(0.3, 0.45),
        translation_noise=NOISE.translation,
        rotation_noise=NOISE.rotation,
    )


@pytest.fixture(scope="module")
def scene():
    return wide_scene(0.02)


@pytest.fixture(scope="module")
def distorted():
    return wide_scene(-0.05)


def contradictions(fit):
    return [warning for warning in fit.warnings if "pictures contradict" in warning]


def value_and_std(sentence, name):
    value, std = re.search(rf"{name} ([-\d.e]+) \+- ([-\d.e]+)", sentence).groups()
    return float(value), float(std)


def standardised_error(fit, scene):
    """The largest error of the mount, in its stated standard deviations."""
    found, true = fit.calibration.camera_from_tool, scene.calibration.camera_from_mount
    turn = (found.rotation() @ true.rotation().inverse()).log()
    error = np.concatenate([found.translation() - true.translation(), turn])
    std = [fit.std[f"camera_from_tool.{p}.{k}"] for p in ("translation", "rotation") for k in "xyz"]
    rows = [fit.parameter_names.index(f"camera_from_tool.{name}") for name in STEP_NAMES]
    np.testing.assert_allclose(np.sqrt(np.diagonal(fit.covariance))[rows], std, rtol=1e-9)
    return np.abs(error / std).max()


def start_with(scene, **camera):
    start = nudged(scene.calibration)
    true = scene.calibration.camera
    return dataclasses.replace(start, camera=dataclasses.replace(true, **camera))


def test_what_is_held_at_its_true_value_is_not_doubted(scene):
    fit = fit_joint(scene.data, start_with(scene), fixed=("camera",))
    assert contradictions(fit) == []
    fit = fit_joint(scene.data, start_with(scene), priors={"camera": Prior(std=1.0)})
    assert contradictions(fit) == []


def test_a_held_principal_point_is_named_with_the_value_that_the_pictures_want(scene):
    true = float(scene.calibration.camera.u0)
    start = start_with(scene, u0=jnp.asarray(true + 5.0))
    fit = fit_joint(scene.data, start, fixed=("camera",))
    (sentence,) = contradictions(fit)
    wanted, std = value_and_std(sentence, "camera.u0")
    assert abs(wanted - true) < 4.0 * std
    assert standardised_error(fit, scene) < 2.5
    # The wrong value is the cause of wide intervals, and not that views are few.
    assert not any("take more views" in warning for warning in fit.warnings)
    assert f"(held at {true + 5.0:.6g})" in sentence
    before, after = map(float, re.search(r"from ([\d.]+) to ([\d.]+) px RMS", sentence).groups())
    assert after == pytest.approx(0.15 * np.sqrt(2.0), rel=0.15)
    assert before > after


def test_a_wrong_value_widens_no_interval_that_right_values_make_narrow(scene):
    """The principal point's u moves the mount along x and about y; the focal length is right."""
    options = {"fixed": ("camera",), "noise": NOISE, "field": None}
    right = fit_joint(scene.data, start_with(scene), **options)
    wrong_u0 = jnp.asarray(float(scene.calibration.camera.u0) + 5.0)
    wrong = fit_joint(scene.data, start_with(scene, u0=wrong_u0), **options)
    assert len(contradictions(wrong)) == 1
    times = {name: wrong.std[name] / std for name, std in right.std.items()}
    assert times["camera_from_tool.translation.x"] > 5.0
    assert times["camera_from_tool.translation.y"] < 1.1
    assert times["camera_from_tool.rotation.x"] < 1.1
    assert standardised_error(wrong, scene) < 2.5


@pytest.mark.parametrize("lens", [Pinhole(), Radial(0.0)])
def test_a_camera_given_without_its_distortion_is_named(distorted, lens):
    """Whether its lens could have a distortion, or not."""
    start = start_with(distorted, lens=lens)
    fit = fit_joint(distorted.data, start, fixed=("camera",), noise=NOISE, field=None)
    (sentence,) = contradictions(fit)
    assert "camera.lens.k1" in sentence
    assert "(held at 0)" in sentence


def test_a_wrong_focal_length_is_named_before_the_target_that_it_makes_look_wrong(scene):
    true = float(scene.calibration.camera.alpha_u)
    wrong = jnp.asarray(0.98 * true)
    fit = fit_joint(scene.data, start_with(scene, alpha_u=wrong, alpha_v=wrong), fixed=("camera",))
    wanted, std = value_and_std(fit.warnings[0], "camera.alpha_u")
    assert abs(wanted - true) < 4.0 * std
    assert "of its stated size" in fit.warnings[1]
    assert "measure" not in fit.warnings[1]
    assert "the values that the pictures contradict" in fit.warnings[1]
    assert not any("focus or zoom change" in warning for warning in fit.warnings)


def test_a_prior_that_the_pictures_contradict_is_named(scene):
    true = float(scene.calibration.camera.u0)
    prior = Prior(mean=true + 20.0, std=2.0)
    fit = fit_joint(scene.data, start_with(scene), priors={"camera.u0": prior})
    (sentence,) = contradictions(fit)
    assert standardised_error(fit, scene) < 2.5
    assert f"prior on camera.u0, {true + 20.0:.6g} +- 2:" in sentence
    wanted, std = value_and_std(sentence, "estimated")
    assert abs(wanted - true) < 4.0 * std


def test_a_prior_that_is_right_is_still_believed_where_another_is_wrong(scene):
    true = scene.calibration.camera
    right = {f"camera.{name}": Prior(std=0.02) for name in ("alpha_u", "alpha_v")}
    wrong = {"camera.u0": Prior(mean=float(true.u0) + 5.0, std=0.1)}
    fit = fit_joint(scene.data, start_with(scene), noise=NOISE, priors=right | wrong)
    assert len(contradictions(fit)) == 1
    error = abs(float(fit.calibration.camera.u0 - true.u0))
    assert 1.0 < error < 2.5 * fit.std["camera.u0"]
    assert max(fit.std[name] for name in right) < 0.03


@pytest.mark.parametrize("gross_errors", ["auto", "keep"])
def test_a_held_mount_is_named_in_millimetres(scene, gross_errors):
    """Also where all views are kept: it is not taken for a robot that errs along its tool."""
    start = start_with(scene)
    moved = start.camera_from_tool.translation() + jnp.array([0.01, 0.0, 0.0])
    true = scene.calibration.camera_from_mount
    mount = type(true).from_rotation_and_translation(true.rotation(), moved)
    start = dataclasses.replace(start, camera_from_mount=mount)
    # A smooth error of the robot could make up for it: its coefficients and the mount are alike.
    options = {"field": None, "gross_errors": gross_errors}
    fit = fit_joint(scene.data, start, fixed=("camera", "camera_from_tool"), **options)
    (sentence,) = contradictions(fit)
    assert "camera_from_tool.translation.x" in sentence
    wanted, std = value_and_std(sentence, "camera_from_tool.translation.x")
    assert abs(wanted - 1e3 * float(true.translation()[0])) < 4.0 * std


def test_both_numbers_of_a_prior_have_names():
    """`Prior(950.0, 1.0)` would be a standard deviation of 950."""
    with pytest.raises(TypeError):
        Prior(950.0, 1.0)


def test_pixels_that_are_not_square_are_named_and_widen_the_mount(scene):
    """The pictures tell the ratio of the focal lengths to some 2e-4, and it is not 1.02."""
    told = {"camera.pixel_aspect": Prior(mean=1.02, std=1e-3)}
    fit = fit_joint(scene.data, start_with(scene), noise=NOISE, priors=told)
    (text,) = contradictions(fit)
    assert "the prior on camera.pixel_aspect, 1.02 +- 0.001: estimated" in text
    value, std = value_and_std(text, "estimated")
    assert abs(value - 1.0) < 4.0 * std < 4e-3
    assert standardised_error(fit, scene) < 3.0
    # What is stated for alpha_u and alpha_v follows the ratio's error, too.
    camera, rows = fit.calibration.camera, [0, 1]
    focal = np.array([float(camera.alpha_u), float(camera.alpha_v)])
    error, covariance = focal - 500.0, fit.covariance[np.ix_(rows, rows)]
    assert error @ np.linalg.solve(covariance, error) < 9.0
    by_focal = np.array([-focal[1] / focal[0], 1.0]) / focal[0]
    std = np.sqrt(by_focal @ covariance @ by_focal)
    assert fit.std["camera.pixel_aspect"] == pytest.approx(std, rel=1e-3)
    told = {"camera.pixel_aspect": Prior(mean=1.0, std=1e-3)}
    fit = fit_joint(scene.data, start_with(scene), noise=NOISE, priors=told)
    assert contradictions(fit) == []
