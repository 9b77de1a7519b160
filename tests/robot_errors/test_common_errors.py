"""A robot's errors about the ones that its type has in common, against errors about zero."""

import dataclasses
import pickle

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from field_programs import actual_pose, motion_between, own_jacobian
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.robot_errors import (
    CommonErrors,
    DHErrors,
    ErrorsOfType,
    JointOffsets,
    LinearInPosition,
    RobotError,
    RobotPrior,
    arm_parameters,
    robot_error_from_dict,
    robot_error_to_dict,
)
from smartview_jax.robots import kuka_lwr4, six_axes

ARM, UNCERTAIN = six_axes(), 2


@pytest.fixture(scope="module")
def common():
    """Common errors of the joints' zeros alone."""
    rng, field = np.random.default_rng(0), DHErrors(ARM)
    mean, root = 1e-3 * rng.normal(size=field.size), 1e-4 * rng.normal(size=(field.size, UNCERTAIN))
    mean[6:], root[6:] = 0.0, 0.0
    return CommonErrors(
        field.names, tuple(mean), tuple(map(tuple, root)), arm_parameters(field.arm)
    )


@pytest.fixture(scope="module")
def error(common):
    field = common.about(DHErrors(ARM))
    return RobotError(field, jnp.asarray(1e-3 * np.random.default_rng(1).normal(size=field.size)))


@pytest.fixture(scope="module")
def command():
    return ARM.command(np.random.default_rng(2).uniform(-1.0, 1.0, (5, 6)))


def test_the_tool_is_where_mean_and_deviation_put_it(common, error, command):
    own, uncertain = np.split(np.asarray(error.coefficients), [-UNCERTAIN])
    whole = np.array(common.mean) + own + np.array(common.root) @ uncertain
    about_zero = RobotError(DHErrors(ARM), jnp.asarray(whole))
    motion = motion_between(actual_pose(error, command), actual_pose(about_zero, command))
    np.testing.assert_allclose(motion, 0.0, atol=1e-13)
    np.testing.assert_allclose(error.whole.coefficients, whole, rtol=1e-13)
    found, expected = (own_jacobian(e, command) for e in (error, about_zero))
    np.testing.assert_allclose(found, expected @ error.field.by_coefficients, atol=1e-12)
    assert error.field.names == (*DHErrors(ARM).names, "common_error.1", "common_error.2")


def test_a_robot_without_errors_has_none_of_its_type(error, command):
    nothing = RobotError.without_errors(error.field)
    motion = motion_between(actual_pose(nothing, command), command.base_from_tool)
    np.testing.assert_allclose(motion, 0.0, atol=1e-13)


def test_a_smaller_field_has_all_that_the_type_has(error):
    sizes = [part.size - UNCERTAIN for part in error.field.nested_fields]
    assert sizes == [JointOffsets(ARM).size, DHErrors(ARM).size]
    mean = np.zeros(DHErrors(ARM).size)
    mean[-1] = 1e-3
    of_links = ErrorsOfType.of(DHErrors(ARM), mean, np.zeros((len(mean), 1)))
    assert [type(part.errors) for part in of_links.nested_fields] == [DHErrors]
    smaller = error.field.nested_fields[0]
    np.testing.assert_array_equal(smaller.mean, error.field.mean[: smaller.errors.size])


def test_files_keep_the_field(error, tmp_path):
    camera, pose = Camera(800.0, 790.0, 321.0, 239.0, Pinhole(), (640, 480)), SE3.identity()
    calibration = Calibration(camera, pose, pose, "eye_in_hand", robot_error=error)
    calibration.save(tmp_path / "calibration.yaml")
    assert eqx.tree_equal(Calibration.load(tmp_path / "calibration.yaml"), calibration)


def test_a_prior_knows_for_which_arm_it_is(common):
    prior = RobotPrior(common_errors=common)
    assert pickle.loads(pickle.dumps(prior)) == prior
    field = prior.about_type(JointOffsets(ARM))
    assert field.errors.names == JointOffsets(ARM).names
    assert prior.about_type(field) is field
    # What is uncertain of the mean has a standard deviation that is known.
    assert prior.medians(field)[-1] == 1.0
    assert prior.log_stds(field)[-1] < 0.02
    others = LinearInPosition.from_poses(SE3.identity((3,)))
    assert prior.about_type(others) is others
    assert prior.about_type(None) is None
    rounded = dataclasses.replace(ARM, theta=ARM.theta + 1e-13)
    assert prior.about_type(JointOffsets(rounded)).errors.arm is rounded
    # The same numbers mean another arm in the other convention, and for joints that slide.
    slides = dataclasses.replace(ARM, prismatic=(True, *ARM.prismatic[1:]))
    for other in (kuka_lwr4(), dataclasses.replace(ARM, convention="modified"), slides):
        with pytest.raises(ValueError, match="are of robots with other Denavit-Hartenberg para"):
            prior.about_type(JointOffsets(other))


def test_a_mean_of_other_errors_is_refused(error):
    """As in a file that was edited by hand."""
    content = robot_error_to_dict(error)
    field = content["field"] | {name: content["field"][name][:1] for name in ("mean", "root")}
    with pytest.raises(ValueError, match="mean: expected a row for each of 24 errors, found 1"):
        robot_error_from_dict(content | {"field": field}, None)


def test_a_prior_of_an_earlier_version_is_read():
    old = RobotPrior(translation_median=1e-4)
    state = old.__getstate__()
    del state["common_errors"]
    restored = object.__new__(RobotPrior)
    restored.__dict__.update(state)
    assert restored.common_errors is None
    assert pickle.loads(pickle.dumps(restored)).translation_median == 1e-4
