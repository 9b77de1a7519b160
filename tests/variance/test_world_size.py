"""All lengths can shrink together without a change in any pixel: no fit may gain by it."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS as VIEWS
from fit_scenes import POINTS
from jaxlie import SE3
from starts import nudged

from smartview_jax import Noise, Prior, fit_joint
from smartview_jax.engine import FittedChain, Parameters, Step, build_problem, host_retract
from smartview_jax.geometry import host_exponentials
from smartview_jax.robot_errors import LinearInPosition, RobotPrior
from smartview_jax.simulation import random_scene
from smartview_jax.variance.possible_models import is_possible, motion_ratio


def weak_robot_scene(seed, millimetres, degrees):
    return random_scene(
        seed,
        VIEWS,
        POINTS,
        translation_noise=1e-3 * millimetres,
        rotation_noise=np.deg2rad(degrees),
    )


@pytest.fixture(scope="module")
def very_weak():
    """A robot with 10 mm and 2 degrees of noise, and its fit."""
    scene = weak_robot_scene(1, 10.0, 2.0)
    return scene, fit_joint(scene.data, nudged(scene.calibration))


def test_a_weak_robot_does_not_shrink_the_world(very_weak):
    scene, fit = very_weak
    assert float(fit.calibration.target_scale) == pytest.approx(1.0, abs=0.2)
    assert fit.noise.translation == pytest.approx(1e-2, rel=0.4)
    assert fit.noise.rotation == pytest.approx(np.deg2rad(2.0), rel=0.4)
    error = fit.calibration.camera_from_tool.translation() - (
        scene.calibration.camera_from_tool.translation()
    )
    assert np.linalg.norm(error) < 0.02


def test_a_weak_robot_is_a_hypothesis_of_its_own(very_weak):
    """For a good robot every halving of the noise is many times as plausible."""
    scene, fit = very_weak
    good_only = RobotPrior(weak_robot_probability=0.0)
    of_good = fit_joint(scene.data, nudged(scene.calibration), robot_prior=good_only)
    assert of_good.noise.translation < fit.noise.translation < 1.2e-2


def all_lengths_longer(problem, names):
    """The direction in which target, transforms and motion grow together, per unit of growth."""
    start = problem.parameters.start
    field = start.field
    growth = dict.fromkeys(names, 0.0) | {"target_scale": 1.0}
    mount, holder = (
        np.asarray(transform.translation())
        for transform in (start.camera_from_tool, start.base_from_world)
    )
    # The field stretches positions about its centre; the world moves by what is missing to that.
    from_centre = holder - np.asarray(field.centre)
    for axis, m, w in zip("xyz", mount, from_centre, strict=True):
        growth[f"camera_from_tool.translation.{axis}"] = m
        growth[f"base_from_world.translation.{axis}"] = w
    for diagonal in (0, 4, 8):
        growth[f"robot_error.translation_by_position.{diagonal}"] = -float(field.reach)
    return np.array([growth[name] for name in names])


@eqx.filter_jit
def without_priors(problem, z):
    """One program for several problems; operation by operation it would be two hundred."""
    return problem.normal_equations_without_priors(z)


@eqx.filter_jit
def offset_at_start(problem):
    return problem.offset_from_prior(problem.unscaled_step(problem.zero_step())).shared


def test_no_view_pays_for_another_size_of_the_world():
    """Evaluated at poses less their noise, the field shrinks the motion and not the noise."""
    scene = weak_robot_scene(0, 5.0, 0.0)
    data = scene.data
    field = LinearInPosition.from_poses(data.base_from_tool)
    sigmas = np.repeat([5e-3, 2e-2], 3)
    corrections = sigmas * np.random.default_rng(0).normal(size=(VIEWS, 6))

    def pull(noise_corrections):
        """Sum of squares by which pixels change along the direction, per unit squared."""
        built = build_problem(
            data,
            scene.calibration,
            noise=Noise(1.0, 1.0, 1.0, field=(1.0, 1.0)),
            field=field,
            free=("target_scale",),
        )
        if noise_corrections is not None:
            built = built.with_noise_corrections(noise_corrections)
        z = Step(jnp.zeros(len(built.shared_names)), jnp.asarray(corrections))
        matrix = without_priors(built.problem, z).matrix.shared
        direction = all_lengths_longer(built.problem, built.shared_names)
        return direction @ np.asarray(matrix) @ direction

    assert pull(corrections) < 1e-6 * pull(None)


def test_a_target_never_loses_its_size():
    calibration = random_scene(0, 3).calibration
    parameters = Parameters(calibration)
    place = parameters.layout.target_scale
    step = jnp.zeros(parameters.layout.size).at[place].set(-7.0)
    retracted, _ = eqx.filter_jit(Parameters.retract)(parameters, Step(step, jnp.zeros((0, 6))))
    assert float(retracted.target_scale) == pytest.approx(np.exp(-7.0))
    assert float(host_retract(calibration, np.asarray(step)).target_scale) == pytest.approx(
        np.exp(-7.0)
    )
    back = eqx.filter_jit(Parameters.step_to)(parameters, retracted)
    np.testing.assert_allclose(back, step, atol=1e-12)


def test_a_prior_of_the_size_is_of_its_logarithm():
    scene = weak_robot_scene(0, 0.1, 0.01)

    def weight_and_mean(prior):
        problem = build_problem(
            scene.data, scene.calibration, free=("target_scale",), priors={"target_scale": prior}
        ).problem
        place = problem.parameters.layout.target_scale
        offset = problem.host_offset_at_start()
        np.testing.assert_allclose(offset, offset_at_start(problem), atol=1e-15)
        return float(np.asarray(problem.prior_weight.shared)[place][0]), float(offset[place][0])

    np.testing.assert_allclose(weight_and_mean(Prior(std=0.01)), (100.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(weight_and_mean(Prior(std=0.01, mean=0.5)), (50.0, np.log(2.0)))
    with pytest.raises(ValueError, match="a size is positive; found a mean of -1"):
        weight_and_mean(Prior(std=0.01, mean=-1.0))


def test_what_no_robot_and_no_target_can_be_is_left_out():
    scene = random_scene(0, 6)
    data, truth = scene.data, scene.calibration
    poses = truth.camera_from_world(data.base_from_tool).as_matrix()

    def chain(calibration, field_corrections=None):
        none = jnp.zeros((data.view_count, 6))
        errors = np.zeros(none.shape) if field_corrections is None else field_corrections
        return FittedChain(calibration, none, host_exponentials(errors), poses)

    assert is_possible(chain(truth), data)
    for scale in (0.19, 5.1):
        assert not is_possible(
            chain(dataclasses.replace(truth, target_scale=jnp.asarray(scale))), data
        )
    # A twist that brings every tool nearly to the centre of its poses.
    reported = np.asarray(data.base_from_tool.as_matrix())
    to_centre = reported[:, :3, 3].mean(axis=0) - reported[:, :3, 3]
    in_tool = np.einsum("vji,vj->vi", reported[:, :3, :3], to_centre)
    cancelling = np.concatenate([0.9 * in_tool, np.zeros_like(in_tool)], axis=1)
    assert motion_ratio(reported, cancelling) == pytest.approx(0.1)
    assert not is_possible(chain(truth, cancelling), data)
    # A target behind the camera.
    behind = dataclasses.replace(
        truth,
        camera_from_mount=SE3.from_translation(jnp.array([0.0, 0.0, -2.0]))
        @ truth.camera_from_mount,
    )
    assert not is_possible(chain(behind), data)
    assert motion_ratio(np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 6))) == 1.0
