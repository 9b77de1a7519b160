import dataclasses
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from field_programs import (
    actual_pose,
    motion_between,
    own_jacobian,
    tool_command,
    twists_by_differences,
)
from fit_scenes import POINTS, scene_of
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.geometry import host_matrices
from smartview_jax.robot_errors import (
    GenericSixAxisArm,
    LinearInPose,
    LinearInPoseWithScales,
    LinearInPosition,
    RobotError,
    ScaleError,
)
from smartview_jax.simulation import paper_calibration

SHARE = 0.03


@pytest.fixture(scope="module")
def scene():
    return scene_of(0, 12, pixel_noise=0.0)


def error(scene, group, counts=None):
    """A robot whose error is one of the stretches, of a camera that the scene's has."""
    poses = scene.data.base_from_tool
    camera = scene.calibration.camera_from_tool.inverse().translation()
    counts = jnp.ones(6) if counts is None else jnp.asarray(counts)
    field = LinearInPoseWithScales(LinearInPose.from_poses(poses), camera, counts)
    place = field.names.index(f"{group}.0")
    return RobotError(field, jnp.zeros(56).at[place].set(SHARE * float(field.linear_in_pose.reach)))


def test_a_stretch_shortens_every_way_by_its_share(scene):
    poses = scene.data.base_from_tool
    found = error(scene, LinearInPoseWithScales.ROBOT_SCALE)
    centre = np.asarray(poses.translation()).mean(axis=0)
    expected = centre + (1.0 - SHARE) * (np.asarray(poses.translation()) - centre)
    true = actual_pose(found, poses)
    np.testing.assert_allclose(true.translation(), expected, atol=1e-12)
    np.testing.assert_allclose(true.rotation().wxyz, poses.rotation().wxyz, atol=1e-12)


def test_a_target_of_another_size_looks_like_the_cameras_stretch(scene):
    """Exactly, with the target moved to where it then seems to be."""
    poses, truth = scene.data.base_from_tool, scene.calibration
    found = error(scene, LinearInPoseWithScales.TARGET_SCALE)
    scaled = dataclasses.replace(truth, target_scale=jnp.asarray(1.0 / (1.0 - SHARE)))
    world, centre = truth.base_from_world, found.field.linear_in_pose.centre
    moved = (1.0 - SHARE) * world.translation() + SHARE * centre
    there = SE3.from_rotation_and_translation(world.rotation(), moved)
    stretched = dataclasses.replace(truth, holder_from_world=there, robot_error=found)
    np.testing.assert_allclose(
        stretched.project(poses, POINTS)[0], scaled.project(poses, POINTS)[0], atol=1e-8
    )


def test_what_does_not_count_does_nothing(scene):
    poses = scene.data.base_from_tool
    off = error(scene, LinearInPoseWithScales.TARGET_SCALE, [1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(off.field.twist(poses, off.coefficients), 0.0)
    basis = np.asarray(off.field.basis(poses))
    np.testing.assert_array_equal(basis[..., :54], off.field.linear_in_pose.basis(poses))
    assert not basis[..., 55].any()
    assert basis[..., 54].any()


def error_besides(kind, poses):
    """Another field's error, and a stretch."""
    field = ScaleError.from_poses(kind.from_poses(poses), poses)
    coefficients = 1e-3 * np.random.default_rng(1).normal(size=field.size)
    return RobotError(field, jnp.asarray(coefficients).at[-1].set(SHARE * float(field.reach)))


@pytest.fixture(scope="module")
def stretched(scene):
    return error_besides(LinearInPosition, scene.data.base_from_tool)


def test_a_field_that_is_stretched_goes_on_from_where_the_field_is(stretched, scene):
    """The tool comes closer to the centre by a share of the reported distance."""
    poses, inner = scene.data.base_from_tool, stretched.field.field
    before = actual_pose(RobotError(inner, stretched.coefficients[:-1]), poses)
    moved = actual_pose(stretched, poses).translation() - before.translation()
    # Carried along by the tool, which the field has turned.
    turned = host_matrices(before)[:, :3, :3] @ host_matrices(poses)[:, :3, :3].swapaxes(1, 2)
    way = np.asarray(poses.translation()) - np.asarray(stretched.field.centre)
    expected = -SHARE * np.einsum("vij,vj->vi", turned, way)
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    none = actual_pose(RobotError(stretched.field, stretched.coefficients.at[-1].set(0.0)), poses)
    np.testing.assert_allclose(motion_between(before, none), 0.0, atol=1e-14)


def test_twists_of_a_scale_are_its_derivatives_and_commands_the_inverse(stretched, scene):
    poses = scene.data.base_from_tool
    found = own_jacobian(stretched, poses)
    np.testing.assert_allclose(found, twists_by_differences(stretched, poses), atol=1e-10)
    assert len(stretched.field.names) == stretched.field.size == found.shape[-1]
    back = tool_command(stretched, actual_pose(stretched, poses))
    np.testing.assert_allclose(motion_between(poses, back), 0.0, atol=1e-10)


@pytest.mark.parametrize("kind", [LinearInPose, GenericSixAxisArm])
def test_files_keep_what_is_stretched(scene, tmp_path, kind):
    """Also under the names that two fields had in earlier versions."""
    stretched = error_besides(kind, scene.data.base_from_tool)
    calibration = dataclasses.replace(paper_calibration(), robot_error=stretched)
    path = tmp_path / "calibration.yaml"
    calibration.save(path)
    found = Calibration.load(path)
    assert eqx.tree_equal(found, calibration)
    assert isinstance(found.robot_error.field.field, kind)
    text = path.read_text()
    assert "scale_error" in text
    text = re.sub(r"\n# checksum.*|\nchecksum:.*", "", text)
    path.write_text(text.replace("scale_error", "stretched").replace("six_axis_arm", "implied_arm"))
    assert eqx.tree_equal(Calibration.load(path), calibration)
