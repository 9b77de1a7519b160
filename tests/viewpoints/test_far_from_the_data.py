"""Far from its data a robot's correction fades, and its uncertainty goes back to the prior's."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from board_scene import calibrated_board, run
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.engine import Noise, Observability, parameter_names
from smartview_jax.geometry import host_matrices
from smartview_jax.grasping import camera_covariance
from smartview_jax.joint.saved_estimate import SavedEstimate
from smartview_jax.robot_errors import LinearInPosition, RobotError
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.viewpoints import viewpoint_commands

REACH = 0.1
COEFFICIENTS = np.concatenate([[2e-5, 0.0, 0.0, 0.0, 1e-5], np.zeros(13)])
PRIOR = 3e-3, 1e-3
"""Prior standard deviations of the coefficients of translation (m) and rotation (rad)."""

BASE_FROM_WORLD = SE3.from_translation(jnp.array([0.0, 0.0, 1.0]))
"""The target is 1 m before the camera."""

_CAMERA = Camera(1000.0, 1000.0, 320.0, 240.0, Pinhole(), (640, 480))
FIELD = LinearInPosition(to_device(np.zeros(3)), to_device(REACH))
CALIBRATION = dataclasses.replace(
    Calibration.eye_in_hand(_CAMERA, SE3.identity(), BASE_FROM_WORLD),
    robot_error=RobotError(FIELD, to_device(COEFFICIENTS)),
)


def poses_at(distances):
    """Camera poses along x, in units of the reach."""
    matrices = np.tile(np.eye(4), (len(distances), 1, 1))
    matrices[:, 0, 3] = REACH * np.asarray(distances)
    return SE3.from_matrix(np.linalg.inv(matrices)) @ BASE_FROM_WORLD


def test_the_correction_fades_beyond_the_data():
    """Near the data it is the fitted field; at 5 times their extent there is none."""
    distances = [0.0, 0.9, 2.0, 5.0]
    commands = viewpoint_commands(CALIBRATION, poses_at(distances))
    corrected = 1e5 * (
        np.asarray(commands.base_from_tool.translation())[:, 0] - REACH * np.array(distances)
    )
    # exp(-d^2 / 2) at d = 1 and 4 beyond the edge, of a correction that would grow by 0.02 mm for
    # each unit; here in units of 0.01 mm.
    expected = [0.0, 1.8, 4.0 * np.exp(-0.5), 10.0 * np.exp(-8.0)]
    np.testing.assert_allclose(corrected, expected, rtol=0.01, atol=1e-6)
    # What is predicted is what was asked for, everywhere.
    np.testing.assert_allclose(
        host_matrices(commands.predicted_views.camera_from_world),
        host_matrices(poses_at(distances)),
        atol=1e-12,
    )
    assert commands.checks.safe.all()
    assert "5.0 times as far out" in commands.checks.reasons()[-1]


def test_the_expected_pose_belongs_to_the_command_where_the_inversion_stops_short():
    """Errors a thousand times as large shrink to a fifth in every step, not to nothing."""
    error = RobotError(FIELD, to_device(1e3 * COEFFICIENTS))
    # As many poses as a padded request, which has the same program.
    wanted = SE3(np.tile(np.eye(7)[0], (16, 1)))
    wanted.wxyz_xyz[:, 4] = REACH * np.linspace(0.2, 0.9, 16)
    command, expected = error.expected_command(wanted)
    assert np.abs(expected.wxyz_xyz - wanted.wxyz_xyz).max() > 1e-9
    again = error.expected_pose(command)
    np.testing.assert_allclose(expected.wxyz_xyz, again.wxyz_xyz, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("distance", "relevance"), [(0.9, 1.0), (2.0, np.exp(-0.5)), (6.0, 0.0)])
def test_the_uncertainty_grows_to_the_priors(distance, relevance):
    """Posterior of a tenth of the prior: near the data the one, far away the other."""
    names = tuple(name for name in parameter_names(CALIBRATION) if "robot_error" in name)
    prior = np.repeat(PRIOR, 9)
    estimate = SavedEstimate(
        CALIBRATION,
        np.diag((0.1 * prior) ** 2),
        names,
        Noise(0.1, 1e-9, 1e-9, PRIOR),
        0.1,
        Observability(len(names), len(names), (), (), 1.0),
    )
    commands = viewpoint_commands(CALIBRATION, poses_at([distance]))
    actual = np.sqrt(np.diagonal(camera_covariance(CALIBRATION, estimate, commands.command)[0])[:3])
    share = np.sqrt((0.1 * relevance) ** 2 + 1.0 - relevance**2)
    np.testing.assert_allclose(actual, distance * PRIOR[0] * share, rtol=0.02)


def test_views_about_the_board_are_not_refused(tmp_path_factory, tmp_path):
    path = calibrated_board(tmp_path_factory).calibration
    ended = run("viewpoint", path, "--five", "--tilt", "15", "--out", tmp_path / "v.csv")
    assert ended.exit_code == 0, ended.output
    assert "v5: error of the camera within +- (" in ended.stdout
