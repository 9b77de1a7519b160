"""A camera that focuses or shifts its pictures by itself is not taken for a robot that errs."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from scipy.spatial.transform import Rotation
from two_hands_scene import BOARD, FIXED_CAMERA, two_hands

from smartview_jax import Calibration, fit_joint, fit_staged
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.joint.camera_like_errors import _is_larger
from smartview_jax.simulation import random_target_scene

ROBOT = {"translation_noise": 1e-4, "rotation_noise": 2e-4}
MIDDLE = np.array([320.0, 240.0])


def warnings_of(scene, pixels):
    data = dataclasses.replace(scene.data, pixels=jnp.asarray(pixels))
    staged = fit_staged(data, "radial").calibration
    return " ".join(fit_joint(data, staged, noise="estimated").warnings)


@pytest.fixture(scope="module")
def scene():
    return scene_of(1, MANY_VIEWS, **ROBOT)


def test_an_autofocus_is_named(scene):
    """Each picture has a focal length of its own, which differs by a percent."""
    zoom = 1.0 + np.random.default_rng(0).normal(0.0, 0.01, (MANY_VIEWS, 1, 1))
    text = warnings_of(scene, MIDDLE + zoom * (np.asarray(scene.data.pixels) - MIDDLE))
    assert "did focus or zoom change between the pictures" in text
    assert "stabiliser" not in text


def test_an_image_stabiliser_is_named(scene):
    shift = np.random.default_rng(0).normal(0.0, 20.0, (MANY_VIEWS, 1, 2))
    text = warnings_of(scene, np.asarray(scene.data.pixels) + shift)
    assert "stabiliser or a program shift the pictures" in text
    assert "focus" not in text


def test_a_camera_that_was_knocked_once_is_no_stabiliser(scene):
    """It tilts the camera as well, but between two views only."""
    knock = np.where(np.arange(MANY_VIEWS) < MANY_VIEWS // 2, 0.0, 20.0)
    shift = knock[:, None, None] * [0.8, -0.6]
    text = warnings_of(scene, np.asarray(scene.data.pixels) + shift)
    assert "implausibly large error of the robot" in text
    assert "stabiliser" not in text


@pytest.mark.parametrize(("first", "second"), [(slice(2, 3), slice(2)), (slice(2), slice(2, 3))])
def test_errors_that_are_equal_in_all_directions_differ_by_chance_alone(first, second, monkeypatch):
    monkeypatch.setattr("smartview_jax.joint.camera_like_errors.MAX_CHANCE", 0.05)
    drawn = np.random.default_rng(0).normal(size=(500, MANY_VIEWS, 3))
    named = [_is_larger(errors[:, first], errors[:, second]) for errors in drawn]
    # Without the largest of the changes it is less often than an F test says.
    assert 0.005 < np.mean(named) < 0.05


def test_a_weak_robot_is_no_camera_that_changes():
    weak = scene_of(0, MANY_VIEWS, translation_noise=3e-3, rotation_noise=np.deg2rad(0.5))
    text = warnings_of(weak, np.asarray(weak.data.pixels))
    assert "implausibly large error of the robot" in text
    assert "focus" not in text
    assert "stabiliser" not in text


def sagging(data):
    """The data of a robot whose tool tilts about horizontal axes."""
    reported = host_matrices(data.base_from_tool).copy()
    tilts = np.random.default_rng(0).normal(0.0, 0.5, (MANY_VIEWS, 3)) * [1.0, 1.0, 0.0]
    sag = Rotation.from_rotvec(tilts, degrees=True).as_matrix()
    reported[:, :3, :3] = sag @ reported[:, :3, :3]
    return dataclasses.replace(data, base_from_tool=as_se3(reported))


def test_a_robot_that_sags_is_no_stabiliser(scene):
    """Its tool tilts as the picture would if the camera looked down."""
    data = sagging(scene.data)
    staged = fit_staged(data, "radial").calibration
    text = " ".join(fit_joint(data, staged, noise="estimated").warnings)
    assert "implausibly large error of the robot" in text
    assert "stabiliser" not in text


@pytest.fixture(scope="module")
def fixed():
    """A camera next to the robot that looks down at a target on its hand."""
    hands = two_hands(0, MANY_VIEWS).calibration
    return Calibration.eye_to_hand(hands.camera, FIXED_CAMERA, hands.other_tool_from_world)


def test_a_robot_that_sags_under_a_fixed_camera_is_no_stabiliser(fixed):
    data = sagging(random_target_scene(3, MANY_VIEWS, BOARD, fixed).data)
    text = " ".join(fit_joint(data, fixed, noise="estimated").warnings)
    assert "implausibly large error of the robot" in text
    assert "stabiliser" not in text


def test_an_autofocus_of_a_fixed_camera_is_named(fixed):
    data = random_target_scene(3, MANY_VIEWS, BOARD, fixed).data
    zoom = 1.0 + np.random.default_rng(0).normal(0.0, 0.01, (MANY_VIEWS, 1, 1))
    middle = np.array([float(fixed.camera.u0), float(fixed.camera.v0)])
    pixels = middle + zoom * (np.asarray(data.pixels) - middle)
    data = dataclasses.replace(data, pixels=jnp.asarray(pixels))
    text = " ".join(fit_joint(data, fixed, noise="estimated").warnings)
    assert "did focus or zoom change between the pictures" in text
    assert "stabiliser" not in text
