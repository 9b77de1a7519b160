"""A fit that was saved says as much of its uncertainty as the fit did."""

import dataclasses
import json
import math

import numpy as np
import pytest
import yaml

import smartview_jax as sv
from smartview_jax import Calibration, fit_joint
from smartview_jax.dataset import picture_digests
from smartview_jax.engine import PoseDirections
from smartview_jax.evaluation import std_of
from smartview_jax.files import read_yaml
from smartview_jax.geometry import host_matrices
from smartview_jax.joint import SavedEstimate, load_estimate
from smartview_jax.modeling import SeenViews
from smartview_jax.modeling.calibration_uncertainty import CalibrationUncertainty


@pytest.fixture
def scene(shaky_scene):
    return shaky_scene


@pytest.fixture
def fit(calibrated):
    return calibrated


def position(calibration: Calibration):
    return calibration.camera_from_tool.translation()


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration.json"])
def test_what_is_read_back_is_what_was_written(fit, tmp_path, name):
    fit.save(tmp_path / name, source="a simulation")
    found = load_estimate(tmp_path / name)
    assert found.parameter_names == fit.parameter_names
    np.testing.assert_array_equal(found.covariance, fit.covariance)
    assert found.noise == fit.noise
    np.testing.assert_allclose(std_of(found, position), std_of(fit, position), rtol=1e-9)
    # Those who only want the calibration read the same file.
    K = Calibration.load(tmp_path / name).camera.K
    np.testing.assert_array_equal(K, fit.calibration.camera.K)
    assert "a simulation" in (tmp_path / name).read_text()


def test_the_pictures_are_recognised_by_the_file(fit, scene, tmp_path):
    fit.save(tmp_path / "fit.yaml")
    digests = read_yaml(tmp_path / "fit.yaml")["pictures"]
    assert digests == list(picture_digests(scene.data))


def test_json_is_json(fit, tmp_path):
    fit.save(tmp_path / "fit.json")
    content = json.loads((tmp_path / "fit.json").read_text())
    assert content["uncertainty"]["parameters"] == list(fit.parameter_names)


def test_a_calibration_of_transforms_alone_can_be_json_too(fit, tmp_path):
    fit.calibration.save(tmp_path / "bare.json")
    assert json.loads((tmp_path / "bare.json").read_text())["mount"] == "eye_in_hand"
    with pytest.raises(ValueError, match=r"bare.json: uncertainty: missing"):
        load_estimate(tmp_path / "bare.json")


def test_features_measured_later_know_both_parts(fit, scene, tmp_path):
    fit.save(tmp_path / "fit.yaml")
    found = load_estimate(tmp_path / "fit.yaml")
    views = SeenViews.of(fit.calibration, scene.data.base_from_tool)
    before = CalibrationUncertainty.of(views, fit.calibration, fit.joint)
    after = CalibrationUncertainty.of(views, found.calibration, found)
    assert after.names == before.names
    np.testing.assert_allclose(after.covariance, before.covariance, rtol=1e-9, atol=1e-24)


SHORT_ROWS = {"in_tool": [[1.0]] * 6, "in_base": [[1.0]] * 6}

DIRECTIONS = PoseDirections.of(np.diag([1e-8, 1e-8, 9e-6, 1e-8, 1e-8, 1e-8]), 1e-8 * np.eye(6))


@pytest.fixture
def along_tool(fit):
    """The saved part of the fit, for a robot that errs along the tool's z axis."""
    saved = SavedEstimate.of(fit.joint)
    return saved._replace(noise=dataclasses.replace(saved.noise, directions=DIRECTIONS))


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration.json"])
def test_the_directions_of_errors_are_read_back(along_tool, tmp_path, name):
    along_tool.save(tmp_path / name)
    assert load_estimate(tmp_path / name).noise == along_tool.noise


def test_views_of_a_robot_that_errs_along_its_tool_are_displaced_along_it(along_tool, scene):
    """By the Jacobian of a view's twist, as with errors alike in all directions."""
    poses = host_matrices(scene.data.base_from_tool)
    views = SeenViews.of(along_tool.calibration, scene.data.base_from_tool)
    found = CalibrationUncertainty.of(views, along_tool.calibration, along_tool)
    known = len(found.covariance) - 6 * len(poses)
    expected = along_tool.noise.pose_covariances(poses[:, :3, :3].swapaxes(1, 2))
    for view, block in enumerate(expected):
        rows = slice(known + 6 * view, known + 6 * view + 6)
        np.testing.assert_allclose(found.covariance[rows, rows], block, rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(expected[:, 2, 2], 9e-6 + 1e-8, rtol=1e-6)


def test_poses_that_were_free_stay_so(scene, fit, tmp_path):
    noise = sv.Noise(pixel=0.3, translation=math.inf, rotation=math.inf)
    held = ("camera_from_tool", "base_from_world")
    fit_joint(scene.data, fit.calibration, noise=noise, fixed=held).save(tmp_path / "free.yaml")
    assert load_estimate(tmp_path / "free.yaml").noise == noise


def test_what_is_undetermined_has_no_covariance(scene, fit, tmp_path):
    # Poses that may be anywhere say nothing of the mount.
    anywhere = sv.Noise(pixel=0.3, translation=math.inf, rotation=math.inf)
    open_fit = fit_joint(scene.data, fit.calibration, noise=anywhere)
    assert open_fit.observability.null_directions
    open_fit.save(tmp_path / "open.yaml")
    with pytest.raises(ValueError, match="uncertainty: missing"):
        load_estimate(tmp_path / "open.yaml")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda u: u["covariance"].pop(), r"covariance: expected \d+ rows"),
        (lambda u: u["covariance"][0].__setitem__(0, -1.0), "variance of camera.alpha_u"),
        (lambda u: u["covariance"][0].__setitem__(1, 9.9), "not symmetric in row 2, column 1"),
        (lambda u: u["parameters"].__setitem__(0, "camera.alpha"), "no parameter 'camera.alpha'"),
        (lambda u: u["noise"].__setitem__("pixel", -0.1), "a standard deviation"),
        (lambda u: u["noise"].update(directions={"in_tool": [[1.0]]}), "in_base"),
        (lambda u: u["noise"].update(directions=SHORT_ROWS), "six rows of six numbers"),
    ],
)
def test_a_wrong_entry_is_named(fit, tmp_path, change, said):
    path = tmp_path / "calibration.yaml"
    fit.save(path)
    content = yaml.safe_load(path.read_text())
    change(content["uncertainty"])
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=said) as caught:
        load_estimate(path)
    assert str(path) in str(caught.value)
