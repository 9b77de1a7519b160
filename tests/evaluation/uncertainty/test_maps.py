"""The maps against `std_of`, which differentiates the chain by JAX instead of by differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax import Noise, cramer_rao, evaluation
from smartview_jax.engine import Parameters, Step, host_retract
from smartview_jax.robot_errors import LinearInPosition, RobotError


@pytest.fixture(scope="module")
def fit(scene):
    """What a fit of a robot with an error would be: its bound is an estimate, too."""
    field = LinearInPosition.from_poses(scene.data.base_from_tool)
    error = RobotError(field, 1e-3 * jnp.asarray(np.random.default_rng(2).normal(size=field.size)))
    calibration = dataclasses.replace(scene.calibration, robot_error=error)
    noise = Noise(0.15, 1e-4, 1e-4, field=(1e-3, 1e-3))
    return cramer_rao(calibration, scene.data, noise, field=field)


def test_a_step_on_the_host_is_that_of_the_engine(fit):
    assert fit.calibration.robot_error is not None
    parameters = Parameters(fit.calibration)
    step = 0.01 * np.random.default_rng(0).normal(size=parameters.layout.size)
    retract = jax.jit(lambda shared: parameters.retract(Step(shared, jnp.zeros((0, 6))))[0])
    expected = retract(step)
    found = host_retract(fit.calibration, step)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_the_map_over_the_picture_is_the_propagated_covariance(fit, scene):
    drawn = evaluation.picture_uncertainty(fit, scene.data, view=2)
    pose = jax.tree.map(lambda leaf: leaf[2], scene.data.base_from_tool)
    camera = fit.calibration.camera
    camera_from_world = fit.calibration.camera_from_world(pose)
    # The places that were drawn, taken back into space at the depth that was stated.
    rays, _ = camera.unproject(jnp.asarray(drawn.pixels[::7]))
    in_camera = drawn.depth * rays / rays[:, 2:]
    points = camera_from_world.inverse().apply(in_camera) / fit.calibration.target_scale
    expected = evaluation.std_of(fit, lambda one: one.project(pose, points)[0])
    np.testing.assert_allclose(
        drawn.std[::7], np.linalg.norm(np.asarray(expected), axis=1), rtol=2e-3
    )
    assert (drawn.pixels.min(axis=0) < [20.0, 20.0]).all()
    assert (drawn.pixels.max(axis=0) > np.array(drawn.image_size) - 20.0).all()


def test_the_map_over_the_workspace_is_of_cameras_that_look_at_its_points(fit, scene):
    drawn = evaluation.workspace_uncertainty(fit, scene.data, count=3)
    assert drawn.points.shape == (3, 3, 3)
    target = np.asarray(scene.data.points)
    height = 0.5 * (target[..., 2].min() + target[..., 2].max())
    np.testing.assert_allclose(drawn.points[..., 2], height)
    # Where the target is, the error is less than twice as far out.
    assert drawn.std[1, 1] < drawn.std.max()
    point = drawn.points[0, 2]
    camera_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_world[:3, 3] = [-point[0], point[1], drawn.distance + point[2]]
    command = fit.calibration.command_for(camera_from_world, corrected=False)
    seen = jnp.asarray(point[None]) / fit.calibration.target_scale
    expected = evaluation.std_of(fit, lambda one: one.project(command, seen)[0])
    focal = float(jnp.sqrt(fit.calibration.camera.alpha_u * fit.calibration.camera.alpha_v))
    metres = float(np.linalg.norm(np.asarray(expected))) * drawn.distance / focal
    assert drawn.std[0, 2] == pytest.approx(metres, rel=5e-3)


def test_a_view_without_points_is_named(fit, scene):
    visible = scene.data.visible.at[5].set(False)
    empty = type(scene.data).from_arrays(
        scene.data.points, scene.data.pixels, scene.data.base_from_tool, (640, 480), visible
    )
    with pytest.raises(ValueError, match="view 5: no point"):
        evaluation.picture_uncertainty(fit, empty, view=5)
