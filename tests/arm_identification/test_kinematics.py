"""An arm's kinematics from measured poses of a target on it."""

import numpy as np
import pytest
from jaxlie import SE3
from scipy.optimize import least_squares

from smartview_jax import fit_kinematics
from smartview_jax.geometry import as_se3, host_exponentials, host_logarithms, host_matrices
from smartview_jax.robots import SerialArm, puma_560

ENDS = host_exponentials(np.array([[0.4, -0.2, 1.1, 0.3, 0.9, -0.5], np.linspace(-0.3, 0.4, 6)]))
RATIOS = np.array([1.01, -0.98])
SCALE = np.repeat([2e-4, 5e-4], 3)


def positioner(prismatic=(False, False)):
    return SerialArm([0.2, 0.0], [0.1, 0.3], [0.05, 0.0], [1.5, 0.0], prismatic=prismatic)


def measured(arm, joints, noise=0.0, seed=0):
    """Poses of a target on an arm, seen by a camera next to it."""
    twists = noise * SCALE * np.random.default_rng(seed).normal(size=(len(joints), 6))
    first, last = ENDS
    base_from_tool = host_matrices(arm.base_from_tool(joints))
    return as_se3(first @ base_from_tool @ last @ host_exponentials(twists))


def grid():
    """Two joints on a grid: between neighbours only one of them moves."""
    return np.stack(np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-2, 2, 5)), -1).reshape(-1, 2)


def random_joints(arm, views=20):
    return np.random.default_rng(1).uniform(-1.0, 1.0, (views, arm.joint_count))


def assert_same_poses(fit, joints, poses):
    found = host_matrices(fit.camera_from_target(joints))
    np.testing.assert_allclose(found, host_matrices(poses), atol=1e-8)


@pytest.mark.parametrize("prismatic", [(False, False), (True, False), (False, True)])
def test_axes_and_ratios_are_found_from_the_poses_alone(prismatic):
    arm, joints = positioner(prismatic), grid()
    fit = fit_kinematics(joints, measured(arm, joints * RATIOS), prismatic=prismatic)
    assert fit.rms_mm < 1e-5
    np.testing.assert_allclose(np.abs(fit.ratios), np.abs(RATIOS), atol=1e-7)
    elsewhere = random_joints(arm)
    assert_same_poses(fit, elsewhere, measured(arm, elsewhere * RATIOS))
    assert fit.arm.prismatic == prismatic
    assert not fit.unobservable


def test_the_numbers_of_an_arm_come_out_of_a_start_that_is_a_little_off():
    """Views at random: which joint does what is for the start to say."""
    arm = puma_560()
    off = SerialArm(arm.theta, arm.d + 0.004, arm.a - 0.003, arm.alpha + 0.01, limits=arm.limits)
    joints = random_joints(arm, 30)
    fit = fit_kinematics(joints, measured(arm, joints), start=off)
    assert fit.rms_mm < 1e-5
    np.testing.assert_allclose(fit.ratios, 1.0, atol=1e-8)
    # What the two ends do not take: the lengths of the upper arm and the forearm.
    np.testing.assert_allclose(fit.arm.a[1:3], arm.a[1:3], atol=1e-7)
    np.testing.assert_allclose(fit.arm.d[3], arm.d[3], atol=1e-7)


def test_the_stated_deviations_are_true():
    """Over runs of noise, errors of the ratios over their stated deviation have size one."""
    arm, joints = positioner(), grid()
    scores = []
    for seed in range(40):
        fit = fit_kinematics(joints, measured(arm, joints, noise=1.0, seed=seed))
        std = np.array([fit.std[f"joint_ratio.{k}"][0] for k in (1, 2)])
        scores.append((np.asarray(fit.ratios) - 1.0) / std)
    # 80 scores: their mean square is known to 16 %.
    assert 0.55 < np.mean(np.square(scores)) < 1.5
    distance = np.sqrt(3.0) * 0.2
    assert fit.rms_mm == pytest.approx(distance, rel=0.25)


def test_no_other_axes_fit_better():
    """SciPy's solver, by differences, begins at the truth and ends at the same squared sum."""
    arm, joints, weight = positioner(), grid(), 0.3
    poses = host_matrices(measured(arm, joints, noise=100.0))
    fit = fit_kinematics(joints, poses, metres_per_radian=weight)
    first, last = ENDS
    # The second joint's axis is where the first joint's link ends.
    link = host_exponentials(np.array([[0, 0, 0.1, 0, 0, 0.2], [0.05, 0, 0, 1.5, 0, 0]]))
    frames = first, first @ link[0] @ link[1]
    home = first @ host_matrices(arm.base_from_tool(np.zeros(2))) @ last

    def residuals(x):
        predicted = home @ host_exponentials(x[12:18])
        for k in (1, 0):
            frame = frames[k] @ host_exponentials(x[6 * k : 6 * k + 6])
            turns = np.outer((1.0 + x[18 + k]) * joints[:, k], [0, 0, 0, 0, 0, 1])
            predicted = frame @ host_exponentials(turns) @ np.linalg.inv(frame) @ predicted
        turned = predicted[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, :3]
        rotations = np.tile(np.eye(4), (len(poses), 1, 1))
        rotations[:, :3, :3] = turned
        shifts = poses[:, :3, 3] - predicted[:, :3, 3]
        return np.hstack([shifts, weight * host_logarithms(rotations)[:, 3:]]).ravel()

    best = 2.0 * least_squares(residuals, np.zeros(20), xtol=1e-12, ftol=1e-14).cost
    ours = np.asarray(fit.residuals) * np.repeat([1.0, weight], 3)
    assert np.sum(ours**2) == pytest.approx(best, rel=1e-8)


def test_ratios_can_be_held():
    arm, joints = positioner(), grid()
    poses = measured(arm, joints * np.array([1.01, 0.98]))
    held = fit_kinematics(joints, poses, free_ratios=False)
    np.testing.assert_array_equal(held.ratios, 1.0)
    assert held.rms_mm > 1.0
    assert "joint_ratio.1" not in held.std


def test_a_model_that_is_wrong_gives_up_what_counts_less():
    arm, joints = positioner(), grid()
    poses = measured(arm, joints * np.array([1.01, 0.98]))
    turns, shifts = (
        fit_kinematics(joints, poses, free_ratios=False, metres_per_radian=weight)
        for weight in (100.0, 0.01)
    )
    assert turns.rms_degrees < shifts.rms_degrees - 1e-4
    assert shifts.rms_mm < turns.rms_mm - 1e-3


def test_what_the_poses_do_not_tell_is_named():
    """A joint that rests may be anywhere."""
    arm, joints = positioner(), random_joints(positioner())
    joints[:, 1] = 0.0
    fit = fit_kinematics(joints, measured(arm, joints), start=arm)
    assert fit.rms_mm < 1e-5
    assert any("joint_ratio.2" in names for names in fit.unobservable)
    assert np.isinf(fit.std["joint_ratio.2"]).all()
    assert np.isfinite(fit.std["joint_ratio.1"]).all()


def test_wrong_input_is_named():
    arm, joints = positioner(), random_joints(positioner())
    poses = measured(arm, joints)
    with pytest.raises(ValueError, match=r"no two views .* axis of joint 1.*give start="):
        fit_kinematics(joints, poses)
    with pytest.raises(ValueError, match="as many poses; found"):
        fit_kinematics(joints[:3], poses)
    with pytest.raises(ValueError, match="start has 6 joints, the readings 2"):
        fit_kinematics(joints, poses, start=puma_560())
    with pytest.raises(ValueError, match="NaN"):
        fit_kinematics(np.full((20, 2), np.nan), poses)
    with pytest.raises(ValueError, match="metres_per_radian: expected a positive number, found 0"):
        fit_kinematics(joints, poses, metres_per_radian=0.0)
    with pytest.raises(ValueError, match="2 poses give 12 numbers; 16 parameters are free"):
        fit_kinematics(joints[:2], SE3(poses.wxyz_xyz[:2]), start=arm)
