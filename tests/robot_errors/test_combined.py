import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from field_jacobians import both_jacobians

from smartview_jax import Calibration
from smartview_jax.robot_errors import (
    CombinedField,
    GenericSixAxisArm,
    LinearInPosition,
    RobotError,
)
from smartview_jax.robots import as_command
from smartview_jax.simulation import paper_calibration, random_scene


@pytest.fixture(scope="module")
def error():
    poses = random_scene(0, 12).data.base_from_tool
    field = CombinedField(LinearInPosition.from_poses(poses), GenericSixAxisArm.from_poses(poses))
    coefficients = 1e-3 * np.random.default_rng(1).normal(size=field.size)
    return RobotError(field, jnp.asarray(coefficients)), poses


def test_errors_follow_one_another(error):
    combined, poses = error
    first, second = np.split(combined.coefficients, [combined.field.first.size])
    tool = poses.inverse() @ RobotError(combined.field.first, first).actual_pose(poses)
    tool = tool @ poses.inverse() @ RobotError(combined.field.second, second).actual_pose(poses)
    expected = poses @ tool
    found = combined.actual_pose(poses)
    np.testing.assert_allclose((expected.inverse() @ found).log(), 0.0, atol=1e-13)


def test_the_twist_of_each_coefficient_is_the_derivative_of_the_pose(error):
    combined, poses = error
    reported = as_command(poses)
    found, expected = both_jacobians(combined.field, reported, combined.coefficients)
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_true_and_reported_poses_are_each_others_inverse(error):
    combined, poses = error
    back = combined.command(combined.actual_pose(poses)).base_from_tool
    np.testing.assert_allclose((poses.inverse() @ back).log(), 0.0, atol=1e-10)


def test_a_file_keeps_it(error, tmp_path):
    combined, poses = error
    bent = dataclasses.replace(paper_calibration(), robot_error=combined)
    bent.save(tmp_path / "calibration.yaml")
    again = Calibration.load(tmp_path / "calibration.yaml")
    expected, found = (one.camera_from_world(poses) for one in (bent, again))
    np.testing.assert_allclose((expected.inverse() @ found).log(), 0.0, atol=1e-12)


def test_groups_of_one_name_cannot_be_told_apart(error):
    _, poses = error
    field = LinearInPosition.from_poses(poses)
    with pytest.raises(ValueError, match="expected groups of other names than the first's"):
        CombinedField(field, field)
