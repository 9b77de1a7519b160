"""Views of an arm whose joint errors are known: the editor takes the readings, not only poses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.editor import ModelSession
from smartview_jax.engine import Observability, parameter_names
from smartview_jax.joint import SavedEstimate
from smartview_jax.modeling import triangulate_points
from smartview_jax.robot_errors import JointOffsets, RobotError
from smartview_jax.robots import Command
from smartview_jax.simulation import six_axis_scene

POINT = np.array([0.17, 0.12, 0.01])
VIEWS = 3


@pytest.fixture(scope="module")
def arm_scene():
    return six_axis_scene(3, views=VIEWS, held_out_views=1).with_joint_readings


@pytest.fixture(scope="module")
def fit(arm_scene):
    """A calibration of the arm's joints, as good as a fit to many views would be."""
    arm = arm_scene.data.arm
    offsets = RobotError(JointOffsets(arm), jnp.linspace(-2e-3, 3e-3, arm.joint_count))
    calibration = dataclasses.replace(arm_scene.calibration, robot_error=offsets)
    held = ("robot_error.joint_offset.1", "robot_error.joint_offset.6")
    known = ("camera_from_tool.", "robot_error.")
    names = [name for name in parameter_names(calibration) if name.startswith(known)]
    names = tuple(name for name in names if name not in held)
    root = 1e-4 * np.random.default_rng(0).normal(size=(len(names), 2 * len(names)))
    determined = Observability(len(names), len(names), (), (), 1.0)
    return SavedEstimate(calibration, root @ root.T, names, None, 0.1, determined)


@pytest.fixture(scope="module")
def command(arm_scene):
    return Command(arm_scene.data.base_from_tool, arm_scene.data.joints)


@pytest.fixture(scope="module")
def pictures(fit):
    width, height = fit.calibration.camera.image_size
    return [np.zeros((height, width), np.uint8)] * VIEWS


def test_the_calibrations_error_is_part_of_a_clicked_point(fit, command, pictures, tmp_path):
    pixels = np.asarray(fit.calibration.project(command, POINT[None])[0])
    path = tmp_path / "model.json"
    with ModelSession(
        fit.calibration, command, pictures, path=path, covariance=fit, click_sigma=0.3
    ) as session:
        point = session.click("v1", pixels[0, 0])
        # A curve through the real arm's views meets the other clicks.
        for name, pixel in zip(("v2", "v3"), pixels[1:, 0], strict=True):
            curve = session.curves("v1", pixels[0, 0])[name].pixels
            assert np.linalg.norm(curve - pixel, axis=1).min() < 30.0
            session.click(name, pixel, point)
        found = session.estimates()[point]
    np.testing.assert_allclose(found.position, POINT, atol=1e-8)
    expected = triangulate_points(
        fit.calibration, command, pixels, covariance=fit, pixel_sigma=0.3
    ).covariance()[0]
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
    part = found.covariance - found.picture_covariance
    assert np.linalg.eigvalsh(part)[-1] > 1e-10
    # The readings are part of what the journal belongs to.
    other = Command(command.base_from_tool, command.joints + 1e-3)
    with pytest.raises(ValueError, match="the journal's joints are"):
        ModelSession(fit.calibration, other, pictures, path=path)


def test_poses_alone_do_not_say_where_an_erring_arm_is(fit, command, pictures):
    with pytest.raises(ValueError, match="give arm"):
        ModelSession(fit.calibration, command.base_from_tool, pictures)


def test_readings_of_another_number_of_views_are_refused(fit, command, pictures):
    with pytest.raises(ValueError, match="joints: expected 3 rows of readings, found"):
        ModelSession(fit.calibration, Command(command.base_from_tool, command.joints[:2]), pictures)
