import inspect
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from field_programs import (
    actual_pose,
    both_jacobians,
    motion_between,
    motion_of_tool,
    tool_command,
)
from jaxlie import SE3
from scipy.spatial.transform import Rotation

from smartview_jax import Calibration, Dataset, fit_joint, fit_many
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.robot_errors import (
    AbstractLinearField,
    LinearInPose,
    LinearInPosition,
    QuadraticInPosition,
    RobotError,
    SmoothInPose,
    checked_field_choice,
)
from smartview_jax.robots import as_command
from smartview_jax.simulation import paper_calibration
from smartview_jax.variance import estimate_noise


class Sag(AbstractLinearField):
    """A user's own: the arm bends down by a coefficient times its reach."""

    softness: jax.Array

    @property
    def groups(self):
        return (("sag", 1),)

    def basis(self, base_from_tool):
        reach = jnp.linalg.norm(base_from_tool.translation(), axis=-1)
        nothing = jnp.zeros_like(reach)
        down = jnp.stack([nothing, nothing, -self.softness * reach], axis=-1)
        shift = base_from_tool.rotation().inverse().apply(down)
        return jnp.concatenate([shift, jnp.zeros_like(shift)], axis=-1)[..., None]


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return SE3.exp(jnp.asarray(rng.normal(size=(12, 6)) * [0.2, 0.3, 0.1, 0.8, 0.8, 0.8]))


@pytest.fixture(scope="module", params=["pose_squared", "own"])
def error(request, poses):
    field = {
        "pose_squared": lambda: SmoothInPose.from_poses(poses),
        "own": lambda: Sag(jnp.asarray(1.5)),
    }[request.param]()
    rng = np.random.default_rng(1)
    return RobotError(field, jnp.asarray(1e-3 * rng.normal(size=field.size)))


def test_each_field_has_the_coefficients_of_its_groups(poses):
    fields = SmoothInPose.from_poses(poses).nested_fields
    kinds = [LinearInPosition, LinearInPose, QuadraticInPosition, SmoothInPose]
    assert [type(field) for field in fields] == kinds
    assert [field.size for field in fields] == [18, 54, 54, 90]
    for kind in kinds:
        assert eqx.tree_equal(kind.from_poses(poses), fields[kinds.index(kind)])


def test_groups_names_and_columns_agree(error, poses):
    field = error.field
    assert len(set(field.names)) == field.size
    assert field.basis(poses).shape == (12, 6, field.size)
    assert field.basis(SE3(poses.wxyz_xyz[3])).shape == (6, field.size)


def test_the_twist_is_linear_in_the_position_in_base_axes(poses):
    """Worked out with SciPy: a matrix times the scaled offset, turned into the tool's frame."""
    field = LinearInPosition.from_poses(poses)
    rng = np.random.default_rng(2)
    shift, turn = 1e-3 * rng.normal(size=(2, 3, 3))
    coefficients = jnp.concatenate([jnp.asarray(shift).ravel(), jnp.asarray(turn).ravel()])
    positions = np.asarray(poses.translation())
    spread = 1.7 * np.sqrt(np.mean(np.var(positions, axis=0)))
    offset = (positions - positions.mean(axis=0)) / spread
    base_from_tool = Rotation.from_quat(np.asarray(poses.rotation().wxyz), scalar_first=True)
    expected = [base_from_tool.inv().apply(offset @ matrix) for matrix in (shift, turn)]
    found = field.twist(poses, coefficients)
    np.testing.assert_allclose(found, np.concatenate(expected, axis=1), atol=1e-15)


def test_the_twist_is_quadratic_in_the_position_in_base_axes(poses):
    """Worked out with SciPy: the scaled offset between two vectors, by a symmetric matrix."""
    field = QuadraticInPosition.from_poses(poses)
    rng = np.random.default_rng(2)
    symmetric = 1e-3 * rng.normal(size=(6, 3, 3))
    symmetric = symmetric + symmetric.swapaxes(1, 2)
    # The squares first, then the products xy, xz and yz, which the form has twice.
    entries = [(0, 0, 1), (1, 1, 1), (2, 2, 1), (0, 1, 2), (0, 2, 2), (1, 2, 2)]
    columns = np.array([times * symmetric[:, i, k] for i, k, times in entries])
    halves = np.concatenate([columns[:, :3].ravel(), columns[:, 3:].ravel()])
    coefficients = jnp.concatenate([jnp.zeros(18), jnp.asarray(halves)])
    positions = np.asarray(poses.translation())
    spread = 1.7 * np.sqrt(np.mean(np.var(positions, axis=0)))
    offset = (positions - positions.mean(axis=0)) / spread
    forms = np.einsum("vi,aik,vk->va", offset, symmetric, offset)
    base_from_tool = Rotation.from_quat(np.asarray(poses.rotation().wxyz), scalar_first=True)
    expected = [base_from_tool.inv().apply(form) for form in (forms[:, :3], forms[:, 3:])]
    found = field.twist(poses, coefficients)
    np.testing.assert_allclose(found, np.concatenate(expected, axis=1), atol=1e-15)


def test_the_largest_field_contains_the_smaller_ones(poses):
    """A group has the same columns in every field that has it."""
    *smaller, largest = SmoothInPose.from_poses(poses).nested_fields
    basis = largest.basis(poses)
    for field in smaller:
        places = [largest.names.index(name) for name in field.names]
        np.testing.assert_allclose(field.basis(poses), basis[..., places], atol=1e-15)


def test_a_field_in_the_pose_sees_turns_that_one_in_position_does_not(poses):
    turned = SE3.from_rotation_and_translation(
        SE3.exp(jnp.ones(6)).rotation() @ poses.rotation(), poses.translation()
    )
    for kind, changes in ((LinearInPosition, False), (LinearInPose, True)):
        field = kind.from_poses(poses)
        # In base axes: the tool's own frame has turned.
        seen = [pose.rotation().as_matrix() @ field.basis(pose)[:, :3] for pose in (poses, turned)]
        assert bool(jnp.allclose(*seen, atol=1e-12)) is not changes


def test_true_and_reported_poses_are_each_others_inverse(error, poses):
    back = tool_command(error, actual_pose(error, poses))
    np.testing.assert_allclose(motion_between(poses, back), 0.0, atol=1e-13)
    forth = actual_pose(error, tool_command(error, poses))
    np.testing.assert_allclose(motion_between(poses, forth), 0.0, atol=1e-13)


def test_fits_see_the_same_error(error, poses):
    reported, actual = host_matrices(poses), host_matrices(actual_pose(error, poses))
    found = motion_of_tool(error, poses)
    np.testing.assert_allclose(found, np.linalg.inv(reported) @ actual, atol=1e-13)


@pytest.fixture(scope="module")
def by_pose(poses):
    """The field that has most."""
    field = SmoothInPose.from_poses(poses)
    return RobotError(field, jnp.asarray(1e-3 * np.random.default_rng(1).normal(size=90)))


def test_the_twist_of_each_coefficient_is_the_derivative_of_the_pose(by_pose, poses):
    """The closed form of the linear fields, against the derivative that any field inherits."""
    reported = as_command(poses)
    found, expected = both_jacobians(by_pose.field, reported, by_pose.coefficients)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_what_the_robot_says_and_where_it_is_differ_by_the_twist(error, poses):
    twists = np.array(error.field.twist(poses, error.coefficients))
    tool_from_base = host_exponentials(twists) @ np.linalg.inv(host_matrices(poses))
    left = tool_from_base @ host_matrices(actual_pose(error, poses)) - np.eye(4)
    np.testing.assert_allclose(left, 0.0, atol=1e-14)


@eqx.filter_jit
def lift(error, poses):
    """The derivative of how high the commanded tools are, and their poses one by one."""

    def height(coefficients):
        moved = RobotError(error.field, coefficients)
        found = jax.vmap(lambda x: moved.command(SE3(x)).base_from_tool.wxyz_xyz)(poses.wxyz_xyz)
        return jnp.sum(found[:, 6]), found

    return jax.grad(height, has_aux=True)(error.coefficients)


def test_works_under_jit_vmap_and_grad(by_pose, poses):
    error = by_pose
    slope, one_by_one = lift(by_pose, poses)
    np.testing.assert_allclose(one_by_one, tool_command(by_pose, poses).wxyz_xyz, atol=1e-15)
    step = 1e-5
    ahead, behind = (
        np.sum(tool_command(RobotError(error.field, error.coefficients + s), poses).wxyz_xyz[:, 6])
        for s in (step, -step)
    )
    np.testing.assert_allclose(np.sum(slope), (ahead - behind) / (2.0 * step), rtol=1e-6)


def calibration_with(error, mount="eye_in_hand"):
    camera = Camera(800.0, 790.0, 321.0, 239.0, Pinhole(), (640, 480))
    return Calibration(
        camera, SE3.exp(jnp.full(6, 0.1)), SE3.exp(jnp.full(6, -0.2)), mount, 1.01, error
    )


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_a_calibration_predicts_and_commands_by_where_the_tool_is(error, poses, mount):
    calibration = calibration_with(error, mount)
    bare = calibration_with(None, mount)
    seen = calibration.camera_from_world(poses)
    expected = bare.camera_from_world(actual_pose(error, poses))
    np.testing.assert_allclose(motion_between(seen, expected), 0.0, atol=1e-13)
    told = calibration.command_for(seen)
    np.testing.assert_allclose(motion_between(told, poses), 0.0, atol=1e-12)


def test_the_bare_chain_is_there_on_request(error, poses):
    calibration, bare = calibration_with(error), calibration_with(None)
    points = np.random.default_rng(0).normal(size=(5, 3))
    for found, expected in (
        (calibration.project(poses, points, corrected=False), bare.project(poses, points)),
        (calibration.project(poses, points), None),
    ):
        if expected is None:
            assert not np.allclose(found[0], bare.project(poses, points)[0], equal_nan=True)
        else:
            np.testing.assert_array_equal(found[0], expected[0])
    told = calibration.command_for(bare.camera_from_world(poses), corrected=False)
    np.testing.assert_allclose(motion_between(told, poses), 0.0, atol=1e-12)


def test_files_keep_the_field(error, tmp_path, poses):
    calibration = calibration_with(error)
    path = tmp_path / "calibration.yaml"
    calibration.save(path)
    own = error.field if isinstance(error.field, Sag) else None
    assert eqx.tree_equal(Calibration.load(path, field=own), calibration)


def test_a_field_the_library_does_not_know_is_named(tmp_path):
    error = RobotError(Sag(jnp.asarray(1.0)), jnp.zeros(1))
    path = tmp_path / "calibration.yaml"
    calibration_with(error).save(path)
    with pytest.raises(ValueError, match=r"calibration.yaml: field is one of .*found 'Sag'"):
        Calibration.load(path)


def test_missing_coefficients_are_named(tmp_path, poses):
    error = RobotError.zero(LinearInPosition.from_poses(poses))
    content = calibration_with(error).to_dict()
    del content["robot_error"]["coefficients"]["rotation_by_position.3"]
    with pytest.raises(
        ValueError, match=r"robot_error.coefficients: missing rotation_by_position.3$"
    ):
        Calibration.from_dict(content)


def test_a_robot_that_only_turned_has_a_field_without_infinities():
    turns = SE3.exp(jnp.asarray([[0.0, 0.0, 0.0, 0.1 * k, 0.0, 0.0] for k in range(12)]))
    # Away from the origin the mean of equal numbers rounds; a real robot trembles.
    for place, tremble in (([0.0, 0.0, 0.0], 0.0), ([0.51, 0.13, 0.77], 1e-6)):
        shifts = np.array(place) + tremble * np.random.default_rng(0).normal(size=(12, 3))
        poses = SE3.from_rotation_and_translation(turns.rotation(), jnp.asarray(shifts))
        field = LinearInPosition.from_poses(poses)
        assert float(jnp.abs(field.basis(poses)).max()) < 1e-5
        assert float(field.normalised_distance(as_command(poses)).max()) < 1e-5


@pytest.mark.parametrize("choice", ["auto", None, "field"])
def test_a_choice_of_a_field_comes_back(poses, choice):
    choice = LinearInPosition.from_poses(poses) if choice == "field" else choice
    assert checked_field_choice(choice) is choice


@pytest.mark.parametrize("choice", ["pose", False])
def test_no_field_is_chosen_by_its_name_or_by_a_truth_value(choice):
    # The tests' own check of types refuses the value too, and is left out here.
    with pytest.raises(ValueError, match=rf"field is .* or a field .*; found {choice!r}"):
        inspect.unwrap(checked_field_choice)(choice)


def test_functions_check_the_field_first(monkeypatch):
    """Whatever the field, `fixed` is wrong too: no call gets as far as compiling."""
    for function in (fit_joint, fit_many, estimate_noise):
        module = sys.modules[inspect.unwrap(function).__module__]
        monkeypatch.setattr(module, "checked_field_choice", inspect.unwrap(checked_field_choice))
    start, poses = paper_calibration(), np.tile(np.eye(4), (3, 1, 1))
    data = Dataset.from_arrays(np.zeros((4, 3)), np.zeros((3, 4, 2)), poses, (640, 480))
    options = {"field": "pose", "fixed": "camera"}
    for call in (
        lambda: inspect.unwrap(fit_joint)(data, start, noise="trusted", **options),
        lambda: inspect.unwrap(fit_many)([data], start, **options),
        lambda: inspect.unwrap(estimate_noise)(data, start, **options),
    ):
        with pytest.raises(ValueError, match=r"^field is .*found 'pose'$"):
            call()
