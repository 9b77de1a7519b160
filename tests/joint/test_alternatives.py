import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from starts import nudged

from smartview_jax import Noise, fit_joint, fit_staged
from smartview_jax.evaluation import deviations
from smartview_jax.joint.alternatives import ENOUGH_FOR_ARM
from smartview_jax.joint.build import build_problem
from smartview_jax.joint.estimate import _Statistics, estimate_noise
from smartview_jax.joint.parameters import Step
from smartview_jax.robots import ImpliedArm, LinearInPose
from smartview_jax.simulation import paper_points, random_scene, six_axis_scene

POINTS = paper_points((0.0, 0.02))[::3]


@pytest.fixture(scope="module")
def arms():
    return [six_axis_scene(seed) for seed in (0, 1, 3)]


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_another_field_needs_no_other_look_at_the_pixels(mount):
    """The normal equations of a problem that has the field from the start, but for its pixels."""
    scene = random_scene(0, 9, POINTS, pixel_noise=0.1)
    data = dataclasses.replace(scene.data, mount=mount)
    truth = dataclasses.replace(scene.calibration, mount=mount)

    def linearised(field):
        unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * len(field.groups))
        built = build_problem(data, truth, noise=unit, field=field)
        views = _Statistics(built, data.usable_views(), 1.0)
        here = Step(jnp.zeros(len(built.names)), jnp.zeros((9, 6)))
        return views, views.linearised(here)

    poses = data.base_from_tool
    arm = ImpliedArm.over(poses)
    views, with_another = linearised(LinearInPose.over(poses))
    group = np.repeat(np.arange(3), [6, 12, 6])
    twists = arm.by_coefficients(data.observations.command, jnp.zeros(24))
    found = with_another.with_field(twists, group, views.known)
    expected = linearised(arm)[1]
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        one, other = np.asarray(one), np.asarray(other)
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_an_arm_that_nobody_described_makes_the_mount_better(arms):
    """Poses alone: its proportions are not the simulated arm's, only its build is."""
    mount, pixels = [], []
    for scene in arms:
        staged = fit_staged(scene.data, "opencv4").calibration
        linear = LinearInPose.over(scene.data.base_from_tool)
        by_pose = fit_joint(scene.data, staged, noise="estimated", field=linear)
        by_arm = fit_joint(scene.data, staged, noise="estimated")
        assert by_arm.estimate.name == "implied_arm"
        truth = scene.calibration.camera_from_tool.translation()
        found = (staged, by_pose.calibration, by_arm.calibration)
        mount.append([np.linalg.norm(c.camera_from_tool.translation() - truth) for c in found])
        pixels.append([deviations(c, scene.unseen).rms for c in found])
    staged, by_pose, by_arm = np.sqrt(np.mean(np.square(mount), axis=0))
    assert by_arm < 0.6 * staged
    assert by_arm < by_pose
    staged, by_pose, by_arm = np.sqrt(np.mean(np.square(pixels), axis=0))
    assert by_arm < 0.5 * by_pose < 0.5 * staged


def test_few_views_are_given_no_arm(arms):
    shown = ENOUGH_FOR_ARM - 1
    data = arms[0].data.without(range(shown, arms[0].data.view_count))
    found = estimate_noise(data, arms[0].calibration.uncorrected)
    assert "implied_arm" not in [other.name for other in found.alternatives]
    found = estimate_noise(
        data, arms[0].calibration.uncorrected, field=ImpliedArm.over(data.base_from_tool)
    )
    assert found.name == "implied_arm"


def test_who_holds_the_robots_error_is_given_none(arms):
    fixed = ("robot_error",)
    found = estimate_noise(arms[0].data, arms[0].calibration.uncorrected, fixed=fixed)
    assert "implied_arm" not in [other.name for other in found.alternatives]


def test_white_noise_is_not_taken_for_an_arm():
    scene = random_scene(3, 15, POINTS, translation_noise=1e-4, rotation_noise=2e-4)
    fit = fit_joint(scene.data, nudged(scene.calibration), noise="estimated")
    gains = {one.name: one.gain for one in fit.estimate.alternatives}
    assert fit.estimate.name == "white"
    assert gains["implied_arm"] < gains["white"] + 6.0
    assert eqx.tree_equal(fit.calibration.robot_error, None)
