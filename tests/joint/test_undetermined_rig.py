"""Rigs whose robots turn about one axis: what moves together is told, and the rest is right."""

import dataclasses

import numpy as np
import pytest
from arms_scene import LEFT_FROM_RIGHT, NOISE, arms_scene
from fit_scenes import POINTS, scene_of
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from smartview_jax import Rig, fit_rig
from smartview_jax.engine import ParameterChoice, Prior
from smartview_jax.evaluation.diagnosis.rig_budget import pose_uncertainties
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.joint.undetermined import undetermined_motion
from smartview_jax.joint.undetermined_rig import undetermined_motion_of_rig
from smartview_jax.simulation import paper_calibration, simulate

NOTHING = ParameterChoice((), (), {})


def test_two_cameras_on_one_hand_are_known_to_each_other():
    start = paper_calibration()
    data = about_one_axis(scene_of(0).data, 0.01)
    data = simulate(start, data.base_from_tool, POINTS, 0, 0.15, 1e-4, 2e-4).data
    twins = Rig({"left": data, "right": data.select(range(6))})
    fit = fit_rig(twins, {"left": start, "right": start}, noise=NOISE)
    names = [
        f"{mount}.translation.{axis}"
        for mount in ("left.camera_from_tool", "right.camera_from_tool")
        for axis in "xyz"
    ]
    open_names = {name for name, std in fit.std.items() if not np.isfinite(std)}
    assert open_names == {*names, "base_from_world.translation.z"}
    (warning,) = (text for text in fit.warnings if "do not determine" in text)
    assert warning.startswith("the data do not determine left.camera_from_tool.translation.x, ")
    relative = fit.relative("left", "right")
    assert np.isfinite(relative.half_widths()).all()
    # The twins are one camera, and so at one place.
    assert np.linalg.norm(host_matrices(relative.transform)[:3, 3]) < 4.0 * relative.std[:3].max()
    found, truth = fit.calibrations["left"].camera_from_tool, start.camera_from_tool
    assert np.linalg.norm(found.translation() - truth.translation()) < 0.01
    assert len(fit.estimate("left").observability.null_directions) == 4
    left, right, between = pose_uncertainties(fit)
    assert left.translation == right.translation == np.inf
    assert np.isfinite([left.rotation, right.rotation, between.translation]).all()


def test_one_camera_in_a_rig_is_held_as_alone():
    data, start = about_one_axis(scene_of(0).data), paper_calibration()
    alone = undetermined_motion(data, start, NOTHING)
    rig = undetermined_motion_of_rig(Rig({"only": data}), {"only": start}, NOTHING, {})
    assert alone.held == rig.held == ("base_from_world.translation.z",)
    assert [name.removeprefix("only.") for name in rig.names] == list(alone.names)
    np.testing.assert_allclose(np.abs(rig.directions), np.abs(alone.directions), atol=1e-12)


def about_one_axis(data, shift=0.1):
    """The data with poses that only turn about the base's z axis, and move."""
    rng, poses = np.random.default_rng(3), host_matrices(data.base_from_tool)
    target = host_matrices(paper_calibration().base_from_world)[:3, 3]
    turned = np.tile(np.eye(4), (len(poses), 1, 1))
    angles = rng.uniform(-1.0, 1.0, (len(poses), 1))
    turned[:, :3, :3] = Rotation.from_rotvec(angles * [0, 0, 1]).as_matrix()
    # About the target, so that a camera still sees it.
    turned[:, :3, 3] = (
        target - turned[:, :3, :3] @ target + rng.uniform(-shift, shift, (len(poses), 3))
    )
    return dataclasses.replace(data, base_from_tool=host_transforms(turned @ poses[0]))


@pytest.mark.parametrize("arm", ["left", "right"])
def test_an_arm_that_turns_about_one_axis_does_not_tell_where_the_other_is(arm):
    """Every picture stays as it is if all is moved by what is named."""
    rig, truths = arms_scene(0)
    cameras = {n: about_one_axis(d) if n.startswith(arm) else d for n, d in rig.cameras.items()}
    rig = rig.with_cameras(cameras)
    bases = {"left": host_transforms(np.eye(4)), "right": host_transforms(LEFT_FROM_RIGHT)}
    motion = undetermined_motion_of_rig(rig, truths, NOTHING, bases, "mounts")
    assert motion.directions.shape == (1, len(motion.names))
    assert motion.held[0].startswith(f"{arm}_table.camera_from_tool.translation")
    base = "base_left_from_base_right"
    assert any(name.startswith(base) for name in motion.undetermined_names)
    other = f"{'right' if arm == 'left' else 'left'}_table.camera_from_tool"
    assert not any(name.startswith(other) for name in motion.undetermined_names)

    step = dict(zip(motion.names, 1e-4 * motion.directions[0], strict=True))
    for camera, data in rig.cameras.items():
        truth, first = truths[camera], np.eye(4) if camera[0] == "l" else LEFT_FROM_RIGHT
        world = first @ host_matrices(truth.base_from_world)
        moved_base = moved(first, base, step) if camera[0] == "r" else first
        views = np.linalg.inv(host_matrices(data.base_from_tool))
        mount = host_matrices(truth.camera_from_tool)
        before = mount @ views @ np.linalg.inv(first) @ world
        after = (
            moved(mount, f"{camera}.camera_from_tool", step)
            @ views
            @ np.linalg.inv(moved_base)
            @ moved(world, "base_from_world", step)
        )
        np.testing.assert_allclose(after, before, atol=1e-7)

    prior = Prior(std=1e-3, mean=0.0)
    known = ParameterChoice((), (), {f"{arm}_table.camera_from_tool.translation": prior})
    assert undetermined_motion_of_rig(rig, truths, known, bases, "mounts").held == ()
    one_arm = rig.of_arm(arm)
    truths_of_arm = {name: truths[name] for name in one_arm.cameras}
    alone = undetermined_motion_of_rig(one_arm, truths_of_arm, NOTHING, {}, "mounts")
    assert alone.held == motion.held


def moved(pose, path, step):
    """The pose after the steps of its parameters; parameters that are not named do not move."""
    shift, turn = (
        np.array([step.get(f"{path}.{part}.{axis}", 0.0) for axis in "xyz"])
        for part in ("translation", "rotation")
    )
    result = pose.copy()
    result[:3, :3] = expm(np.cross(np.eye(3), -turn)) @ pose[:3, :3]
    result[:3, 3] += shift
    return result
