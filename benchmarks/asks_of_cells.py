"""Further questions of `asks`: rigs, poses without pictures, boards, hobby arms, depth, ROS 2."""

from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax import simulation
from smartview_jax.dataset import PoseDataset
from smartview_jax.detection import detect
from smartview_jax.geometry import host_exponentials, host_matrices
from smartview_jax.io import read_april_grid
from smartview_jax.robots import six_axes
from smartview_jax.targets import AprilGrid

from .small_arm import SMALL_ARM, small_arm_scene

if TYPE_CHECKING:
    from .asks import Material


def several_cameras(_: "Material") -> str:
    """Calibrate two cameras of one robot, and say where the second is."""
    scene = simulation.six_axis_rig_scene(1, cameras=2)
    fit = sv.calibrate(scene.rig)
    relative = fit.relative("camera1", "camera2")
    first, second = (scene.calibrations[name].camera_from_mount for name in ("camera1", "camera2"))
    truth = np.asarray((first @ second.inverse()).translation())
    error = 1e3 * float(np.linalg.norm(host_matrices(relative.transform)[:3, 3] - truth))
    assert error < 0.3
    return f"one fit: the second camera in the first one's frame is off by {error:.2f} mm"


def tracked_poses(material: "Material") -> str:
    """Calibrate from poses of a tracker, one of which is wrong."""
    data = material.scene.data
    poses = host_matrices(material.scene.calibration.camera_from_world(data.command))
    noise = np.random.default_rng(0).normal(0.0, [[3e-4] * 3 + [1e-3] * 3], (len(poses), 6))
    poses = poses @ host_exponentials(noise)
    poses[4, :3, 3] += 0.03
    fit = sv.fit_poses(PoseDataset.from_poses(data.base_from_tool, poses))
    assert [entry.view for entry in fit.rejected] == ["4"]
    distance, angle = fit.tracker_noise
    return (
        f"tracker +- {1e3 * distance:.2f} mm and {np.rad2deg(angle):.2f} degrees, one wrong pair "
        "left out; print(fit) has the intervals"
    )


def april_grid(material: "Material") -> str:
    """Read Kalibr's description of a board, and find the board in a picture."""
    path = material.folder / "target.yaml"
    path.write_text(
        "target_type: 'aprilgrid'\ntagCols: 4\ntagRows: 3\ntagSize: 0.006\ntagSpacing: 0.3\n"
    )
    board = read_april_grid(path)
    scene = simulation.random_target_scene(0, 1, board, tilt=0.2)
    pose = SE3(scene.base_from_tool.wxyz_xyz[0])
    picture = simulation.render(scene.calibration, pose, board)
    seen = detect(picture, board).visible.sum()
    assert seen == len(board.points)
    other = AprilGrid(3, 4, 0.006, 0.3, border_bits=1)
    reason = detect(picture, other).reason or ""
    assert "border" in reason
    return f"{seen} corners by Kalibr's own target.yaml; with a wrong border: {reason[:90]}"


def bent_board(_: "Material") -> str:
    """Calibrate with a board whose corners are 0.3 mm higher than its middle."""
    y, x = np.indices((4, 4)).reshape(2, -1)
    flat = np.stack([0.02 * x, 0.04 / 3 * y, np.zeros(16)], axis=1)
    square = np.sum((flat[:, :2] - flat[:, :2].mean(axis=0)) ** 2, axis=1)
    bent = flat + np.outer(3e-4 * (square - square.mean()) / np.ptp(square), [0.0, 0.0, 1.0])
    scene = simulation.random_scene(
        0, 16, bent, translation_noise=3e-5, rotation_noise=np.deg2rad(0.005)
    )
    data = sv.Dataset.from_arrays(
        flat, np.asarray(scene.data.pixels), scene.data.base_from_tool, scene.data.image_size
    )
    warnings = " ".join(sv.calibrate(data, "radial").warnings)
    assert "the target bows by" in warnings
    return warnings[warnings.index("the target bows by") :]


def hobby_arm(_: "Material") -> str:
    """Calibrate an arm of five axes whose zeros are wrong by degrees, by its own prior."""
    scene = small_arm_scene(1)
    start = sv.fit_staged(scene.data, "opencv4").calibration
    fit = sv.fit_joint(scene.data, start, robot_prior=SMALL_ARM)
    true = scene.truth.camera_from_tool.translation()
    error = np.asarray(fit.calibration.camera_from_tool.translation() - true)
    widths = [fit.confidence_half_width(f"camera_from_tool.translation.{axis}") for axis in "xyz"]
    assert (np.abs(error) < np.array(widths)).all()
    return (
        f"mount known to {1e3 * max(widths):.1f} mm (95 %), off by "
        f"{1e3 * np.linalg.norm(error):.1f} mm"
    )


def depth_camera(material: "Material") -> str:
    """Calibrate a depth camera that measures two percent too far, by points of the target."""
    scene = material.scene
    board = sv.targets.Chessboard(3, 4, 0.03).points
    poses = host_matrices(scene.calibration.camera_from_world(scene.data.command))
    measured = board @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    noise = np.random.default_rng(0).normal(0.0, 2e-4, measured.shape)
    poses = sv.depth.poses_from_points(1.02 * measured + noise, board)
    fit = sv.fit_poses(poses.dataset(scene.data.base_from_tool))
    assert abs(poses.sensor.scale - 1.0 / 1.02) < 0.004
    true = scene.calibration.camera_from_tool.translation()
    error = np.linalg.norm(fit.calibration.camera_from_tool.translation() - true)
    return f"{poses.sensor.described}; mount off by {1e3 * error:.2f} mm"


def ros2(material: "Material") -> str:
    """Write what ROS 2 takes, and the node that answers `smartview capture`."""
    launch = material.command("export", material.saved, "--to", "ros_launch")
    assert "static_transform_publisher" in launch
    calib = material.command("export", material.saved, "--to", "easy_handeye")
    assert "eye_in_hand" in calib
    node = material.command("capture", "--print-program", "ros2")
    assert "rclpy" in node
    bags = material.command("import", "--help")
    assert ".mcap" in bags
    return "bags in (ROS 1, ROS 2, MCAP); launch file, easy_handeye2's file and a node for capture"


def calibrated_urdf(material: "Material") -> str:
    """Write an arm with its errors; the file's forward kinematics has to be the real arm's."""
    calibration = simulation.six_axis_rig_scene(1, 1).calibrations["camera1"]
    error = calibration.robot_error
    assert error is not None
    path = material.folder / "arm.urdf"
    path.write_text(sv.io.robot_urdf(calibration))
    joints = jnp.array([[0.1, -0.4, 0.3, 0.2, -0.5, 0.6]])
    command = six_axes().command(joints)
    real = host_matrices(error.actual_pose(command))
    read = host_matrices(sv.io.load_urdf(path, tip="tool0").base_from_tool(joints))
    np.testing.assert_allclose(read, real, atol=1e-9)
    return "joint zeros, links and camera; its forward kinematics is confirmed to 1e-9"
