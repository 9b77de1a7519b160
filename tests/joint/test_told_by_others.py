"""An arm that turns about one axis: another arm tells what its own motion leaves open."""

import dataclasses

import numpy as np
import pytest
from arms_scene import LEFT_FROM_RIGHT, NOISE, arms_scene, truth_of
from scipy.spatial.transform import Rotation

from smartview_jax import Prior, Rig, fit_rig
from smartview_jax.engine import STEP_NAMES
from smartview_jax.geometry import host_logarithms, host_matrices, host_transforms
from smartview_jax.joint.undetermined_motion import UndeterminedMotion
from smartview_jax.simulation import simulate

CAMERAS = ("left_table", "right_table")

PLACE = "right_table.camera_from_tool"


@pytest.fixture(scope="module")
def rig():
    """The right arm turns about z of its base alone; a view ahead looks at the target."""
    rig, truths = arms_scene(0)
    truth, data = truths["right_table"], rig.cameras["right_table"]
    poses, rng = host_matrices(data.base_from_tool), np.random.default_rng(3)
    target = host_matrices(truth.base_from_world)[:3, 3]
    turned = np.tile(np.eye(4), (len(poses), 1, 1))
    angles = rng.uniform(-0.6, 0.6, (len(poses), 1))
    turned[:, :3, :3] = Rotation.from_rotvec(angles * [0.0, 0.0, 1.0]).as_matrix()
    shifts = rng.uniform(-0.01, 0.01, (len(poses), 3))
    turned[:, :3, 3] = target - turned[:, :3, :3] @ target + shifts
    seen = simulate(
        truth,
        host_transforms(turned @ poses[0]),
        np.asarray(data.points)[0],
        7,
        translation_noise=NOISE.translation,
        rotation_noise=NOISE.rotation,
    ).data
    seen = dataclasses.replace(seen, view_ids=data.view_ids)
    cameras = {"left_table": rig.cameras["left_table"], "right_table": seen}
    return Rig(cameras, rig.targets, rig.arms)


def test_of_held_parameters_enough_stay_to_hold_what_all_arms_leave_open():
    """One arm holds b and c for its two open directions; together one is left, largest along a."""
    motion = UndeterminedMotion(("a", "b", "c"), np.array([[0.8, 0.6, 0.0]]), ("a",))
    assert motion.pinned_by(("c", "b")) == ("b",)
    assert motion.pinned_by(("c", "d")) == ("c", "d")
    assert UndeterminedMotion((), np.zeros((0, 0)), ()).pinned_by(("c", "d")) == ()


def known_base(std):
    """Priors on where the right base is in the left one."""
    values = np.r_[LEFT_FROM_RIGHT[:3, 3], host_logarithms(LEFT_FROM_RIGHT)[3:]]
    path = "base_left_from_base_right"
    return {
        f"{path}.{name}": Prior(std=std, mean=float(value))
        for name, value in zip(STEP_NAMES[:3], values, strict=False)
    }


@pytest.mark.parametrize(("std", "noise"), [(2e-3, NOISE), (1e-4, "estimated")])
def test_a_known_base_and_the_other_arm_tell_the_place_along_the_axis(rig, std, noise):
    """The start is 20 mm off along the axis, which no picture of the right arm alone tells."""
    starts = {camera: truth_of(camera) for camera in CAMERAS}
    mount = host_matrices(starts["right_table"].camera_from_tool)
    tool = host_matrices(rig.cameras["right_table"].base_from_tool)[0]
    along = mount[:3, :3] @ np.linalg.inv(tool)[:3, :3] @ [0.0, 0.0, 1.0]
    moved = mount.copy()
    moved[:3, 3] += 0.02 * along
    target = host_matrices(starts["right_table"].base_from_world).copy()
    target[2, 3] -= 0.02
    starts["right_table"] = dataclasses.replace(
        starts["right_table"],
        camera_from_mount=host_transforms(moved),
        holder_from_world=host_transforms(target),
    )
    lenses = [f"{camera}.camera" for camera in CAMERAS]
    options = {"noise": noise, "field": None, "fixed": lenses}
    fit = fit_rig(rig, starts, priors=known_base(std), **options)
    found = host_matrices(fit.calibrations["right_table"].camera_from_tool)
    error = (found - mount)[:3, 3] @ along
    names = [f"{PLACE}.{name}" for name in STEP_NAMES[:3]]
    rows = [fit.parameter_names.index(name) for name in names]
    sigma = np.sqrt(along @ fit.covariance[np.ix_(rows, rows)] @ along)
    assert std < sigma < std + 1.5e-3
    assert abs(error) < 3.0 * sigma
    assert min(fit.degrees_of_freedom[name] for name in names) > 10.0
    own = fit.estimate("right_table")
    rows = [own.parameter_names.index(f"camera_from_tool.{name}") for name in STEP_NAMES[:3]]
    np.testing.assert_allclose(
        np.sqrt(along @ own.covariance[np.ix_(rows, rows)] @ along), sigma, rtol=1e-6
    )
