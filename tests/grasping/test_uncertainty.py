"""Errors at the gripper against many simulated calibrations of one and the same grasp."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from solids import box

import smartview_jax as sv
from smartview_jax.geometry import host_adjoints, host_exponentials, host_logarithms, host_matrices
from smartview_jax.grasping import GraspScene, PlacedObject
from smartview_jax.grasping.uncertainty import error_covariance, gripper_errors
from smartview_jax.robots import Command, Gripper
from smartview_jax.simulation import random_scene

GRIPPER = Gripper()
NOISE = sv.Noise(pixel=0.15, translation=1e-4, rotation=1e-4)


@pytest.fixture(scope="module")
def setup():
    scene = random_scene(0, views=12, pixel_noise=0.15)
    bound = sv.cramer_rao(scene.calibration, scene.data, NOISE)
    estimate = SimpleNamespace(
        calibration=bound.calibration,
        covariance=bound.covariance,
        parameter_names=bound.parameter_names,
        observability=bound.observability,
        noise=NOISE,
    )
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = [0.02, 0.01, 0.015]
    tool = pose @ np.linalg.inv(GRIPPER.tool_from_gripper)
    base_from_tool = host_matrices(scene.calibration.base_from_world) @ tool
    command = Command(sv.geometry.host_transforms(base_from_tool[None]))
    return GraspScene(scene.calibration, estimate=estimate), command, pose


def test_the_adjoint_is_jaxlie_s():
    rng = np.random.default_rng(0)
    pose = host_exponentials(rng.standard_normal(6))
    twist = 1e-3 * rng.standard_normal(6)
    left = host_exponentials(host_adjoints(pose) @ twist) @ pose
    assert np.allclose(left, pose @ host_exponentials(twist), atol=1e-14)
    assert np.allclose(host_adjoints(pose), sv.geometry.as_se3(pose).adjoint())


def test_where_the_gripper_goes_varies_as_it_is_said(setup):
    """base_from_world drawn from its covariance, and the robot's own noise: tau's covariance."""
    scene, command, pose = setup
    (errors,) = gripper_errors(scene, GRIPPER, command)
    names = [f"base_from_world.{part}.{k}" for part in ("translation", "rotation") for k in "xyz"]
    estimate = scene.estimate
    at = [estimate.parameter_names.index(name) for name in names]
    covariance = estimate.covariance[np.ix_(at, at)]
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    base_from_world = host_matrices(scene.calibration.base_from_world)
    true = np.tile(base_from_world, (4000, 1, 1))
    # Rotations are stepped from the left, translations added (`engine.parameters`).
    steps = host_exponentials(np.concatenate([np.zeros((4000, 3)), draws[:, 3:]], axis=1))
    true[:, :3, :3] = steps[:, :3, :3] @ true[:, :3, :3]
    true[:, :3, 3] += draws[:, :3]
    # tool_from_base = exp(c) reported.
    corrections = host_exponentials(1e-4 * rng.standard_normal((4000, 6)))
    reported = host_matrices(command.base_from_tool)[0]
    actual = reported @ np.linalg.inv(corrections)
    grippers = np.linalg.inv(true) @ actual @ GRIPPER.tool_from_gripper
    # exp(tau) gripper_from_world, of the truth over the estimate.
    taus = host_logarithms(np.linalg.inv(grippers) @ pose)
    found = errors.shared @ errors.shared.T + errors.by_noise @ errors.by_noise.T
    # 4000 draws know a standard deviation to 1.1 %.
    ratio = np.sqrt(np.diagonal(np.cov(taus.T)) / np.diagonal(found))
    assert np.all(np.abs(ratio - 1.0) < 0.05)


def test_what_object_and_gripper_share_cancels(setup):
    """An object that the same wrong base_from_world displaced is displaced with the gripper."""
    scene, command, pose = setup
    (errors,) = gripper_errors(scene, GRIPPER, command)
    model = box(0.03, 0.02, 0.02)
    gripper_from_object = np.linalg.inv(pose)
    # The object's tangent moves so that eta = tau + Ad xi vanishes in what is shared.
    back = -host_adjoints(np.linalg.inv(gripper_from_object))
    shared = back @ errors.shared
    jacobian = shared @ np.linalg.pinv(errors.root)
    own = 1e-10 * np.eye(6)
    localized = PlacedObject(model, np.eye(4), own + shared @ shared.T)
    alone = error_covariance(localized, gripper_from_object, errors)
    known = SimpleNamespace(
        model=localized.model,
        world_from_object=localized.world_from_object,
        covariance=localized.covariance,
        calibration_jacobian=jacobian,
        calibration_names=errors.names,
    )
    together = error_covariance(known, gripper_from_object, errors)
    left = together[:6, :6] - errors.by_noise @ errors.by_noise.T
    adjoint = host_adjoints(gripper_from_object)
    assert np.allclose(left, adjoint @ own @ adjoint.T, atol=1e-13)
    assert np.all(np.diagonal(alone)[:6] > np.diagonal(together)[:6])
    # The gripper's own error is what it was.
    assert np.allclose(alone[6:, 6:], together[6:, 6:])


def test_derivatives_of_another_calibration_are_refused(setup):
    scene, command, pose = setup
    (errors,) = gripper_errors(scene, GRIPPER, command)
    known = SimpleNamespace(
        model=box(),
        world_from_object=np.eye(4),
        covariance=np.eye(6),
        calibration_jacobian=np.zeros((6, 3)),
        calibration_names=errors.names[:2],
    )
    with pytest.raises(ValueError, match=r"calibration_jacobian: expected \(6, 2\)"):
        error_covariance(known, np.linalg.inv(pose), errors)
    known.calibration_names = ("right.camera.u0", *errors.names[:2])
    with pytest.raises(ValueError, match=r"no number 'right.camera.u0'; where several cameras saw"):
        error_covariance(known, np.linalg.inv(pose), errors)


def test_an_exact_calibration_adds_nothing(setup):
    scene, command, pose = setup
    (errors,) = gripper_errors(dataclasses.replace(scene, estimate=None), GRIPPER, command)
    assert errors.shared.shape == (6, 0)
    localized = PlacedObject(box(), np.eye(4), 1e-6 * np.eye(6))
    total = error_covariance(localized, np.linalg.inv(pose), errors)
    adjoint = host_adjoints(np.linalg.inv(pose))
    assert np.allclose(total[:6, :6], 1e-6 * adjoint @ adjoint.T)
    assert np.all(total[6:] == 0.0)


def test_poses_out_of_reach_are_named(setup):
    """An arm with errors of its own has no command for them."""
    scene, command, _ = setup
    poses = host_matrices(command.base_from_tool).repeat(3, axis=0)
    poses[[0, 2]] = np.nan
    with pytest.raises(ValueError, match="the arm does not reach pose 1, 3 of 3: without"):
        gripper_errors(scene, GRIPPER, Command(sv.geometry.as_se3(poses)))
