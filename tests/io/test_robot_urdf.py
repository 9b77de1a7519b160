"""A calibrated arm in URDF moves as the calibration says, by the kinematics of other programs."""

import dataclasses
import xml.etree.ElementTree as ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax import Calibration
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_urdf, robot_urdf
from smartview_jax.robot_errors import (
    DHErrors,
    ElasticDHErrors,
    JointOffsets,
    JointRatios,
    LinearInPosition,
    RobotError,
)
from smartview_jax.robots import SerialArm, kuka_lwr4, puma_560
from smartview_jax.simulation import paper_calibration

SLIDING = SerialArm(
    [0.1, 0.0, 0.3],
    [0.2, 0.1, 0.0],
    [0.3, 0.0, 0.1],
    [0.4, -1.2, 0.3],
    convention="modified",
    prismatic=[False, True, False],
)


def calibrated(arm, mount="eye_in_hand", field=DHErrors):
    """A calibration with errors of all zeros, lengths and twists, of some mm and degrees."""
    errors = field(arm)
    coefficients = np.random.default_rng(3).normal(scale=0.01, size=errors.size)
    error = RobotError(errors, jnp.asarray(coefficients))
    ends = paper_calibration()
    return Calibration(
        ends.camera, ends.camera_from_mount, ends.holder_from_world, mount, robot_error=error
    )


def readings(arm, count=5):
    limits = np.clip(np.asarray(arm.limits), -2.0, 2.0)
    return np.random.default_rng(5).uniform(*limits.T, (count, arm.joint_count))


def camera_in_base(calibration, joints):
    """What has to come out: by the calibration's own model of the arm."""
    arm = calibration.field.arm
    base_from_tool = host_matrices(calibration.robot_error.actual_pose(arm.command(joints)))
    camera = np.linalg.inv(host_matrices(calibration.camera_from_mount))
    in_base = base_from_tool @ camera if calibration.mount == "eye_in_hand" else camera
    return base_from_tool, np.broadcast_to(in_base, base_from_tool.shape)


def poses_by_tree(text, joints):
    """A reader of its own: joints as XML, products of matrices, the poses of all links."""
    root = ElementTree.fromstring(text)
    movable = [j for j in root.iter("joint") if j.get("type") != "fixed"]
    value = {j.get("name"): q for j, q in zip(movable, joints, strict=True)}
    poses = {"base_link": np.eye(4)}
    for joint in root.iter("joint"):
        origin = joint.find("origin")
        pose, motion = np.eye(4), np.eye(4)
        pose[:3, 3] = np.array(origin.get("xyz").split(), dtype=float)
        pose[:3, :3] = Rotation.from_euler(
            "xyz", np.array(origin.get("rpy").split(), dtype=float)
        ).as_matrix()
        if joint.get("type") != "fixed":
            axis = np.array(joint.find("axis").get("xyz").split(), dtype=float)
            q = value[joint.get("name")]
            if joint.get("type") == "prismatic":
                motion[:3, 3] = q * axis
            else:
                motion[:3, :3] = Rotation.from_rotvec(q * axis).as_matrix()
        parent = poses[joint.find("parent").get("link")]
        poses[joint.find("child").get("link")] = parent @ pose @ motion
    return poses


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("arm", [puma_560(), kuka_lwr4(), SLIDING], ids=["puma", "kuka", "slide"])
def test_forward_kinematics_of_the_file_is_that_of_the_calibration(arm, mount):
    calibration = calibrated(arm, mount)
    text = robot_urdf(calibration)
    joints = readings(arm)
    tools, cameras = camera_in_base(calibration, joints)
    # Not the nominal arm's, which is off by millimetres.
    nominal = host_matrices(arm.base_from_tool(joints))
    assert np.abs(nominal - tools).max() > 1e-3
    for k, row in enumerate(joints):
        poses = poses_by_tree(text, row)
        np.testing.assert_allclose(poses["tool0"], tools[k], atol=1e-12)
        np.testing.assert_allclose(poses["camera_optical_frame"], cameras[k], atol=1e-12)


@pytest.mark.parametrize("arm", [puma_560(), kuka_lwr4()], ids=["puma", "kuka"])
def test_mujoco_agrees(arm):
    mujoco = pytest.importorskip("mujoco")
    calibration = calibrated(arm)
    spec = mujoco.MjSpec.from_string(robot_urdf(calibration))
    spec.compiler.fusestatic = False
    # MuJoCo simulates bodies, and so it wants masses, which a calibration does not know.
    for body in spec.bodies[1:]:
        body.mass, body.inertia, body.explicitinertial = 1.0, np.ones(3), True
    model = spec.compile()
    state = mujoco.MjData(model)
    joints = readings(arm)
    tools, cameras = camera_in_base(calibration, joints)
    for k, row in enumerate(joints):
        state.qpos[:] = row
        mujoco.mj_kinematics(model, state)
        for name, expected in (("tool0", tools[k]), ("camera_optical_frame", cameras[k])):
            body = state.body(name)
            np.testing.assert_allclose(body.xpos, expected[:3, 3], atol=1e-9)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), expected[:3, :3], atol=1e-9)


def test_yourdfpy_agrees(tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    calibration = calibrated(kuka_lwr4())
    path = tmp_path / "arm.urdf"
    path.write_text(robot_urdf(calibration))
    robot = yourdfpy.URDF.load(str(path), load_meshes=False)
    joints = readings(calibration.field.arm)
    tools, cameras = camera_in_base(calibration, joints)
    for k, row in enumerate(joints):
        robot.update_cfg(row)
        np.testing.assert_allclose(robot.get_transform("tool0"), tools[k], atol=1e-9)
        np.testing.assert_allclose(
            robot.get_transform("camera_optical_frame"), cameras[k], atol=1e-9
        )


def test_a_urdf_is_read_back_as_the_same_arm_with_its_limits(tmp_path):
    calibration = calibrated(puma_560(), field=JointOffsets)
    path = tmp_path / "arm.urdf"
    path.write_text(robot_urdf(calibration, tool="flange", joint_names=list("abcdef")))
    arm = load_urdf(path, tip="flange")
    joints = readings(arm)
    tools, _ = camera_in_base(calibration, joints)
    np.testing.assert_allclose(host_matrices(arm.base_from_tool(joints)), tools, atol=1e-12)
    np.testing.assert_allclose(arm.limits, calibration.field.arm.limits)


def test_an_arm_without_errors_is_named(tmp_path):
    calibration = paper_calibration()
    with pytest.raises(ValueError, match="the calibration knows no arm"):
        robot_urdf(calibration)
    poses = poses_by_tree(robot_urdf(calibration, puma_560()), np.zeros(6))
    expected = host_matrices(puma_560().base_from_tool(np.zeros(6)))
    np.testing.assert_allclose(poses["tool0"], expected, atol=1e-12)


def test_joints_that_hardly_bend_are_rigid_and_others_are_refused():
    """An average over models has a trace of bending; 1e-4 rad is what robots usually repeat."""
    rigid = calibrated(puma_560())
    coefficients = np.asarray(rigid.robot_error.coefficients)
    bending = []
    for compliance in (5e-5, -2e-4):
        bent = np.append(coefficients, np.full(6, compliance))
        error = RobotError(ElasticDHErrors(puma_560()), jnp.asarray(bent))
        bending.append(dataclasses.replace(rigid, robot_error=error))
    assert robot_urdf(bending[0]) == robot_urdf(rigid)
    with pytest.raises(ValueError, match=r"joints bend by up to 0\.011 degrees"):
        robot_urdf(bending[1])


def test_what_no_urdf_can_say_is_refused():
    with pytest.raises(ValueError, match="gear ratios"):
        robot_urdf(calibrated(puma_560(), field=JointRatios))
    smooth = LinearInPosition.from_poses(puma_560().base_from_tool(readings(puma_560())))
    calibration = dataclasses.replace(paper_calibration(), robot_error=RobotError.zero(smooth))
    with pytest.raises(ValueError, match="is not of joints and links"):
        robot_urdf(calibration)
    for wrong in ({"tool": 'a"b'}, {"tool": "link_2"}, {"joint_names": ["a"]}):
        with pytest.raises(ValueError, match="name"):
            robot_urdf(calibrated(puma_560()), **wrong)
