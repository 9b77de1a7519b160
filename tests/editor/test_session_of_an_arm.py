"""Views of an arm whose joint errors are known: the editor takes the readings, not only poses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Calibration, Camera
from smartview_jax.cameras import Radial
from smartview_jax.editor import ModelSession
from smartview_jax.engine import Observability, parameter_names
from smartview_jax.joint import SavedEstimate
from smartview_jax.modeling import triangulate_points
from smartview_jax.robot_errors import JointOffsets, RobotError
from smartview_jax.robots import Command, six_axes

POINT = np.array([0.17, 0.12, 0.01])
VIEWS = 3


READINGS = np.array(
    [
        [0.040, -0.210, 0.690, -0.097, 1.059, -0.391],
        [-0.173, -0.252, 0.608, 0.113, 1.138, -1.347],
        [0.107, -0.079, 0.605, -0.028, 1.005, -2.937],
    ]
)
"""Joint angles, rad, at which the camera sees what lies on the table before the arm."""


@pytest.fixture(scope="module")
def fit():
    """A calibration of the arm's joints, as good as a fit to many views would be."""
    camera = Camera(1056.0, 1056.0, 958.0, 587.0, Radial(0.1), (1920, 1200))
    bare = Calibration.eye_in_hand(
        camera,
        SE3.exp(jnp.array([-0.02, 0.06, -0.09, 0.03, -0.05, 0.1])),
        SE3.exp(jnp.array([0.55, -0.12, 0.05, 0.01, -0.02, 0.15])),
    )
    offsets = RobotError(JointOffsets(six_axes()), jnp.linspace(-2e-3, 3e-3, 6))
    calibration = dataclasses.replace(bare, robot_error=offsets)
    held = ("robot_error.joint_offset.1", "robot_error.joint_offset.6")
    known = ("camera_from_tool.", "robot_error.")
    names = [name for name in parameter_names(calibration) if name.startswith(known)]
    names = tuple(name for name in names if name not in held)
    root = 1e-4 * np.random.default_rng(0).normal(size=(len(names), 2 * len(names)))
    determined = Observability(len(names), len(names), (), (), 1.0)
    return SavedEstimate(calibration, root @ root.T, names, None, 0.1, determined)


@pytest.fixture(scope="module")
def command():
    return six_axes().command(READINGS)


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
        actual = session.estimates()[point]
    np.testing.assert_allclose(actual.position, POINT, atol=1e-8)
    expected = triangulate_points(
        fit.calibration, command, pixels, covariance=fit, pixel_sigma=0.3
    ).covariance()[0]
    np.testing.assert_allclose(actual.covariance, expected, rtol=1e-6)
    part = actual.covariance - actual.picture_covariance
    assert np.linalg.eigvalsh(part)[-1] > 1e-10
    # A journal belongs to its pictures, and to the joint readings as well.
    other = Command(command.base_from_tool, command.joints + 1e-3)
    with pytest.raises(ValueError, match="joints differ"):
        ModelSession(fit.calibration, other, pictures, path=path)


def test_poses_alone_do_not_say_where_an_erring_arm_is(fit, command, pictures):
    with pytest.raises(ValueError, match="give arm"):
        ModelSession(fit.calibration, command.base_from_tool, pictures)


def test_readings_of_another_number_of_views_are_refused(fit, command, pictures):
    with pytest.raises(ValueError, match="joints: expected 3 rows of readings, found"):
        ModelSession(fit.calibration, Command(command.base_from_tool, command.joints[:2]), pictures)
