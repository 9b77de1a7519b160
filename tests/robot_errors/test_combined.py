import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from field_programs import (
    actual_pose,
    motion_between,
    motion_of_tool,
    own_jacobian,
    twists_by_differences,
)
from fit_scenes import scene_of

from smartview_jax import Calibration
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.robot_errors import (
    CombinedField,
    GenericSixAxisArm,
    LinearInPosition,
    RobotError,
)
from smartview_jax.simulation import paper_calibration


@pytest.fixture(scope="module")
def error():
    poses = scene_of(0, 12).data.base_from_tool
    field = CombinedField(LinearInPosition.from_poses(poses), GenericSixAxisArm.from_poses(poses))
    coefficients = 1e-3 * np.random.default_rng(1).normal(size=field.size)
    return RobotError(field, jnp.asarray(coefficients)), poses


def test_errors_follow_one_another(error):
    combined, poses = error
    coefficients, count = np.asarray(combined.coefficients), combined.field.first.size
    is_first = np.arange(len(coefficients)) < count
    reported, moved = host_matrices(poses), []
    for active in (is_first, ~is_first):
        part = RobotError(combined.field, jnp.asarray(np.where(active, coefficients, 0.0)))
        moved.append(np.linalg.inv(reported) @ host_matrices(actual_pose(part, poses)))
    expected = host_transforms(reported @ moved[0] @ moved[1])
    np.testing.assert_allclose(
        motion_between(expected, actual_pose(combined, poses)), 0.0, atol=1e-13
    )
    alone = RobotError(combined.field.first, jnp.asarray(coefficients[:count]))
    np.testing.assert_allclose(
        reported @ moved[0], host_matrices(actual_pose(alone, poses)), atol=1e-13
    )


def test_the_twist_of_each_coefficient_is_the_derivative_of_the_pose(error):
    expected = twists_by_differences(*error)
    np.testing.assert_allclose(own_jacobian(*error), expected, atol=1e-10)


def test_fits_see_the_same_error(error):
    """They compute it by matrices, and by each field relative to the reported pose."""
    combined, poses = error
    reported, actual = host_matrices(poses), host_matrices(actual_pose(combined, poses))
    found = motion_of_tool(combined, poses)
    np.testing.assert_allclose(found, np.linalg.inv(reported) @ actual, atol=1e-13)


def test_a_file_keeps_a_combined_error(error, tmp_path):
    combined, poses = error
    bent = dataclasses.replace(paper_calibration(), robot_error=combined)
    bent.save(tmp_path / "calibration.yaml")
    again = Calibration.load(tmp_path / "calibration.yaml").robot_error
    np.testing.assert_allclose(
        motion_between(actual_pose(combined, poses), actual_pose(again, poses)), 0.0, atol=1e-12
    )


def test_groups_of_one_name_cannot_be_told_apart(error):
    _, poses = error
    field = LinearInPosition.from_poses(poses)
    with pytest.raises(ValueError, match="expected groups of other names than the first's"):
        CombinedField(field, field)
