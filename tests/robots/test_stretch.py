import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.robots import LinearInPose, PoseOrStretch, RobotError
from smartview_jax.simulation import paper_points, random_scene

SHARE = 0.03
POINTS = paper_points((0.0,))[::5]


@pytest.fixture(scope="module")
def scene():
    return random_scene(0, 6, POINTS, pixel_noise=0.0)


def error(scene, group, counts=None):
    """A robot whose error is one of the stretches, of a camera that the scene's has."""
    poses = scene.data.base_from_tool
    camera = scene.calibration.camera_from_tool.inverse().translation()
    counts = jnp.ones(6) if counts is None else jnp.asarray(counts)
    field = PoseOrStretch(LinearInPose.over(poses), camera, counts)
    place = field.names.index(f"{group}.0")
    return RobotError(field, jnp.zeros(56).at[place].set(SHARE * float(field.pose.reach)))


def test_a_stretch_shortens_every_way_by_its_share(scene):
    poses = scene.data.base_from_tool
    found = error(scene, PoseOrStretch.STRETCH)
    centre = np.asarray(poses.translation()).mean(axis=0)
    expected = centre + (1.0 - SHARE) * (np.asarray(poses.translation()) - centre)
    true = found.true_pose(poses)
    np.testing.assert_allclose(true.translation(), expected, atol=1e-12)
    np.testing.assert_allclose(true.rotation().wxyz, poses.rotation().wxyz, atol=1e-12)


def test_a_target_of_another_size_looks_like_the_cameras_stretch(scene):
    """Exactly, with the target moved to where it then seems to be."""
    poses, truth = scene.data.base_from_tool, scene.calibration
    found = error(scene, PoseOrStretch.SCALE)
    scaled = dataclasses.replace(truth, target_scale=jnp.asarray(1.0 / (1.0 - SHARE)))
    world, centre = truth.base_from_world, found.field.pose.centre
    moved = (1.0 - SHARE) * world.translation() + SHARE * centre
    there = SE3.from_rotation_and_translation(world.rotation(), moved)
    stretched = dataclasses.replace(truth, holder_from_world=there, robot_error=found)
    np.testing.assert_allclose(
        stretched.project(poses, POINTS)[0], scaled.project(poses, POINTS)[0], atol=1e-8
    )


def test_what_does_not_count_does_nothing(scene):
    poses = scene.data.base_from_tool
    off = error(scene, PoseOrStretch.SCALE, [1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(off.field.twist(poses, off.coefficients), 0.0)
    basis = np.asarray(off.field.basis(poses))
    np.testing.assert_array_equal(basis[..., :54], off.field.pose.basis(poses))
    assert not basis[..., 55].any()
    assert basis[..., 54].any()
