"""A wrong calibration displaces a found object and the gripper alike: little is left between both.

The objects are found by `localize` in pictures that were taken with another base_from_world than
the calibration says, and the error of the grasp is compared with the covariance stated for it.
"""

import dataclasses

import numpy as np
from drawn_edges import calibration, drawn, evidence, together
from placed_box import MODEL, NOISE, OTHER_POSE, POSE, views_of_both

from smartview_jax.engine import Observability
from smartview_jax.geometry import (
    host_adjoints,
    host_exponentials,
    host_logarithms,
    host_matrices,
    host_transforms,
)
from smartview_jax.grasping import GraspScene, PlacedObject
from smartview_jax.grasping.uncertainty import error_covariance, gripper_errors
from smartview_jax.joint import SavedEstimate
from smartview_jax.localization import Hypothesis, localize
from smartview_jax.modeling import find_symmetry
from smartview_jax.robots import Command, Gripper

CALIBRATION, GRIPPER = calibration(), Gripper()
NAMES = tuple(f"base_from_world.{part}.{k}" for part in ("translation", "rotation") for k in "xyz")
SPREAD = np.repeat([2e-3, 2e-3], 3)
"""Standard deviations of base_from_world: much more than pictures and robot leave of the pose."""

ESTIMATE = SavedEstimate(
    CALIBRATION, np.diag(SPREAD**2), NAMES, NOISE, 0.1, Observability(6, 6, (), (), 1.0)
)
SYMMETRIC = dataclasses.replace(MODEL, name="box", symmetry=find_symmetry(MODEL))
DOWN = host_exponentials(np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))


def world_moved(draw):
    """The true base_from_world: translations are added, rotations stepped from the left."""
    step = host_exponentials(np.concatenate([np.zeros(3), draw[3:]]))
    step[:3, 3] = draw[:3]
    return step


def found_in(base_from_world, poses, covariance, rng):
    """What is found of boxes at poses in the true world, with the pictures that it shows."""
    views = views_of_both()
    true = views._replace(camera_from_world=views.camera_from_world @ base_from_world)
    pictures = together(*(drawn(MODEL, true, pose, 0.05, rng) for pose in poses))
    # The calibration has the world where the base is, and the objects with it.
    starts = [Hypothesis(0, base_from_world @ pose, 0.0, 0.0) for pose in poses]
    # The commands are padded, for programs of one size.
    command = host_matrices(views.command.base_from_tool)[: len(views.camera_from_world)]
    return localize(
        evidence(pictures),
        command,
        CALIBRATION,
        SYMMETRIC,
        covariance=covariance,
        hypotheses=starts,
    ).accepted


def grasp_error(found, pose, base_from_world):
    """The true eta and tau, with the pose of the object in the gripper's frame and its errors."""
    world_from_gripper = found.world_from_object @ DOWN
    base_from_tool = world_from_gripper @ np.linalg.inv(GRIPPER.tool_from_gripper)
    command = Command(host_transforms(base_from_tool[None]))
    (errors,) = gripper_errors(GraspScene(CALIBRATION, estimate=ESTIMATE), GRIPPER, command)
    # exp(tau) gripper_from_world is the true world seen from where the gripper really goes.
    actual = np.linalg.inv(base_from_world) @ world_from_gripper
    tau = host_logarithms(np.linalg.inv(actual) @ world_from_gripper)
    gripper_from_object = np.linalg.inv(DOWN)
    # Of the poses that are equal by symmetry, the nearest.
    twists = [
        host_logarithms(np.linalg.inv(equivalent) @ pose) for equivalent in found.equivalent_poses
    ]
    xi = min(twists, key=np.linalg.norm)
    return tau + host_adjoints(gripper_from_object) @ xi, tau, gripper_from_object, errors


def test_what_localize_and_the_gripper_share_cancels():
    rng, squares = np.random.default_rng(0), []
    for _ in range(2):
        world = world_moved(SPREAD * rng.standard_normal(6))
        localizations = found_in(world, (POSE, OTHER_POSE), ESTIMATE, rng)
        assert len(localizations) == 2
        for localization in localizations:
            pose = min(
                (POSE, OTHER_POSE),
                key=lambda p: np.linalg.norm((p - localization.world_from_object)[:3]),
            )
            eta, tau, gripper_from_object, errors = grasp_error(localization, pose, world)
            stated = error_covariance(localization, gripper_from_object, errors)
            # The object errs by millimetres, and the gripper with it.
            assert np.linalg.norm(eta[:3]) < 0.2 * np.linalg.norm(tau[:3])
            squares.append(eta @ np.linalg.solve(stated[:6, :6], eta))
            alone = PlacedObject(SYMMETRIC, localization.world_from_object, localization.covariance)
            apart = error_covariance(alone, gripper_from_object, errors)
            # Independent errors of both would make the variance ten times as large.
            assert np.trace(stated[:3, :3]) < 0.1 * np.trace(apart[:3, :3])
            np.testing.assert_allclose(stated[6:, 6:], apart[6:, 6:])
    # The 99.9 % quantile of six degrees of freedom is 22.5: what is stated covers what happened.
    assert max(squares) < 22.5


def test_an_exact_calibration_has_no_numbers_to_share():
    (localization,) = found_in(np.eye(4), (POSE,), None, np.random.default_rng(1))
    assert localization.calibration_jacobian is None
