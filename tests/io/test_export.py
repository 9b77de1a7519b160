import dataclasses
import re
import shlex
from xml.etree import ElementTree

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from jaxlie import SE3
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from smartview_jax import Calibration, Camera
from smartview_jax.cameras import Fisheye, OpenCV4, OpenCV5, OpenCV8, Radial
from smartview_jax.cli import app
from smartview_jax.io import (
    kalibr_camchain,
    opencv_coefficients,
    opencv_yaml,
    ros_camera_info,
    ros_launch_file,
    ros_static_transform,
    urdf_origin,
)
from smartview_jax.simulation import paper_calibration

LENSES = {
    "plumb_bob": OpenCV5(0.1, -0.2, 0.001, 0.002, 0.05),
    "rational_polynomial": OpenCV8(0.5, -0.2, 0.001, 0.002, 0.05, 0.6, -0.1, 0.03),
    "equidistant": Fisheye(-0.02, 0.003, -0.001, 0.0001),
}


def calibration(lens):
    camera = Camera(800.0, 790.0, 320.5, 239.5, lens, (640, 480))
    return Calibration.eye_in_hand(
        camera,
        SE3.exp(jnp.array([0.02, -0.05, 0.1, 0.3, -0.2, 1.5])),
        SE3.exp(jnp.array([0.5, 0.1, 0.0, 0.1, 0.0, 0.4])),
    )


def tool_from_camera(cal):
    return np.linalg.inv(np.asarray(cal.camera_from_tool.as_matrix()))


@pytest.mark.parametrize("model", LENSES)
def test_opencv_reads_its_own_format(tmp_path, model):
    cal = calibration(LENSES[model])
    (tmp_path / "cal.yaml").write_text(opencv_yaml(cal))
    file = cv2.FileStorage(str(tmp_path / "cal.yaml"), cv2.FILE_STORAGE_READ)
    K = file.getNode("camera_matrix").mat()
    distortion = file.getNode("distortion_coefficients").mat()
    hand_eye = file.getNode("camera_from_tool").mat()
    np.testing.assert_allclose(hand_eye, cal.camera_from_tool.as_matrix(), atol=1e-15)
    assert file.getNode("distortion_model").string() == model
    points = np.random.default_rng(0).uniform([-0.2, -0.2, 1.0], [0.2, 0.2, 1.5], (20, 3))
    zero = np.zeros(3)
    if model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, distortion)
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, K, distortion)
    projected, _ = cal.camera.project(jnp.asarray(points))
    np.testing.assert_allclose(projected, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("k1", [0.3, -0.1])
def test_the_papers_lens_becomes_the_nearest_polynomial_and_says_how_near(k1):
    cal = calibration(Radial(k1))
    lens = opencv_coefficients(cal.camera)
    assert lens.model == "plumb_bob"
    assert lens.coefficients[0] == pytest.approx(-k1, rel=0.2)
    nearest = Camera(800.0, 790.0, 320.5, 239.5, OpenCV5(*lens.coefficients), (640, 480))
    rays, _ = cal.camera.unproject(jnp.array([[0.0, 0.0], [639.0, 479.0], [320.0, 100.0]]))
    gap = np.abs(np.asarray(nearest.project(rays)[0] - cal.camera.project(rays)[0])).max()
    assert gap <= lens.max_deviation < 0.05
    assert "px off" in ros_camera_info(cal).splitlines()[0]


def test_camera_info_is_yaml_with_the_camera():
    cal = calibration(LENSES["plumb_bob"])
    content = yaml.safe_load(ros_camera_info(cal, "wrist"))
    assert content["camera_name"] == "wrist"
    assert content["distortion_model"] == "plumb_bob"
    np.testing.assert_allclose(content["camera_matrix"]["data"][:3], [800.0, 0.0, 320.5])
    np.testing.assert_allclose(
        content["distortion_coefficients"]["data"], [0.1, -0.2, 0.001, 0.002, 0.05]
    )


def test_the_static_transform_is_the_camera_in_the_tool():
    cal = calibration(Radial(0.1))
    text = ros_static_transform(cal, "tool0", "camera_optical_frame")
    values = {key: float(x) for key, x in re.findall(r"--(q?[xyzw]) (\S+)", text)}
    expected = tool_from_camera(cal)
    np.testing.assert_allclose([values[a] for a in "xyz"], expected[:3, 3], atol=1e-15)
    rotation = Rotation.from_quat([values[f"q{a}"] for a in "xyzw"]).as_matrix()
    np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-12)
    assert "--frame-id tool0 --child-frame-id camera_optical_frame" in text


def test_the_launch_file_starts_the_same_publisher():
    cal = calibration(Radial(0.1))
    (node,) = ElementTree.fromstring(ros_launch_file(cal, "tool0", "camera_link", False))
    assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
    line = ros_static_transform(cal, "tool0", "camera_link", False)
    assert line.split()[4:] == node.get("args").split()
    with pytest.raises(ValueError, match="frame"):
        ros_launch_file(cal, 'tool"0', "camera_link")


def test_urdf_and_the_body_frame():
    cal = calibration(Radial(0.1))
    expected = tool_from_camera(cal)
    xyz, rpy = (
        np.array(text.split(), dtype=float)
        for text in re.findall(r'(?:xyz|rpy)="([^"]*)"', urdf_origin(cal))
    )
    np.testing.assert_allclose(xyz, expected[:3, 3], atol=1e-15)
    np.testing.assert_allclose(
        Rotation.from_euler("xyz", rpy).as_matrix(), expected[:3, :3], atol=1e-12
    )
    body = re.search(r'rpy="([^"]*)"', urdf_origin(cal, optical=False))
    assert body is not None
    turned = Rotation.from_euler("xyz", np.array(body[1].split(), dtype=float)).as_matrix()
    # The body's x looks where the optical z looks, its z up where the optical y looks down.
    np.testing.assert_allclose(turned[:, 0], expected[:3, 2], atol=1e-12)
    np.testing.assert_allclose(turned[:, 2], -expected[:3, 1], atol=1e-12)


@pytest.mark.parametrize("frame", ["tool0; rm -rf .", "tool 0", "$(date)", "", "-x", "tool\n0"])
def test_a_frame_that_a_shell_would_run_is_refused(frame):
    """The line is made to be pasted into a shell."""
    with pytest.raises(ValueError, match="frame: expected a name of letters, digits"):
        ros_static_transform(paper_calibration(), frame, "camera")
    with pytest.raises(ValueError, match="frame: expected a name of letters, digits"):
        ros_static_transform(paper_calibration(), "tool0", frame)


def test_frames_of_ros_are_taken():
    line = ros_static_transform(paper_calibration(), "robot_1/tool0", "~cam")
    words = shlex.split(line)
    assert words[words.index("--frame-id") + 1] == "robot_1/tool0"
    assert words[words.index("--child-frame-id") + 1] == "~cam"
    assert "'~cam'" in line


@pytest.mark.parametrize("to", ["camera_info", "opencv"])
def test_a_file_with_a_lens_that_is_none_is_refused(tmp_path, to):
    path = tmp_path / "calibration.yaml"
    calibration(LENSES["plumb_bob"]).save(path)
    text = path.read_text()
    assert text.count("k3: ") == 1
    path.write_text(text.replace("k3: ", "k9: "))
    ended = CliRunner().invoke(app, ["export", str(path), "--to", to])
    assert ended.exit_code == 2
    assert "calibration.yaml: camera.lens: expected the numbers" in ended.stderr


@pytest.mark.parametrize("optical", [True, False])
@pytest.mark.parametrize("pitch", [0.3, 0.5 * np.pi, -0.5 * np.pi, 0.5 * np.pi - 1e-9])
def test_the_angles_are_the_rotation_also_where_two_of_them_are_one(pitch, optical):
    """Straight down, as a camera looks at a table, only yaw minus roll is determined."""
    rotation = Rotation.from_euler("xyz", [0.4, pitch, -0.7])
    mount_from_camera = np.eye(4)
    mount_from_camera[:3, :3] = rotation.as_matrix()
    cal = calibration(LENSES["plumb_bob"])
    cal = Calibration.eye_in_hand(cal.camera, np.linalg.inv(mount_from_camera), cal.base_from_world)
    rpy = re.search(r'rpy="([^"]*)"', urdf_origin(cal, optical))
    actual = Rotation.from_euler("xyz", np.array(rpy[1].split(), dtype=float)).as_matrix()
    link = np.eye(3) if optical else np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    np.testing.assert_allclose(actual, rotation.as_matrix() @ link, atol=1e-14)


def moved(cal, motion):
    """The same camera elsewhere on its mount."""
    shift = SE3.exp(jnp.array(motion))
    return dataclasses.replace(cal, camera_from_mount=shift @ cal.camera_from_mount), shift


def test_kalibrs_chain_has_each_camera_in_the_one_before():
    """As Kalibr defines T_cn_cnm1: it maps points of the camera before to this one."""
    left = calibration(OpenCV4(0.1, -0.2, 0.001, 0.002))
    right, shift = moved(left, [0.06, 0.01, -0.02, 0.1, -0.2, 0.3])
    content = yaml.safe_load(kalibr_camchain({"left": left, "right": right}))
    assert list(content) == ["cam0", "cam1"]
    assert "T_cn_cnm1" not in content["cam0"]
    np.testing.assert_allclose(content["cam1"]["T_cn_cnm1"], shift.as_matrix(), atol=1e-12)
    assert content["cam1"]["intrinsics"] == [800.0, 790.0, 320.5, 239.5]
    assert content["cam1"]["resolution"] == [640, 480]
    fixed = dataclasses.replace(left, mount="eye_to_hand")
    with pytest.raises(ValueError, match="kalibr: the cameras move against each other"):
        kalibr_camchain({"left": left, "fixed": fixed})


def test_kalibrs_lenses_keep_their_numbers():
    lenses = {"radtan": OpenCV4(0.1, -0.2, 0.001, 0.002), "equidistant": LENSES["equidistant"]}
    for model, lens in lenses.items():
        content = yaml.safe_load(kalibr_camchain({"a": calibration(lens)}))["cam0"]
        assert content["distortion_model"] == model
        assert content["distortion_coeffs"] == [float(k) for k in vars(lens).values()]
    with pytest.raises(ValueError, match="Kalibr has no lens like that of a: calibrate with lens"):
        kalibr_camchain({"a": calibration(LENSES["plumb_bob"])})


def test_the_command_exports_several_cameras(tmp_path):
    left = calibration(OpenCV4(0.1, -0.2, 0.001, 0.002))
    cameras = {"left": left, "right": moved(left, [0.06, 0.0, 0.0, 0.1, 0.0, 0.0])[0]}
    for name, cal in cameras.items():
        cal.save(tmp_path / f"{name}.yaml")
    files = [str(tmp_path / f"{name}.yaml") for name in cameras]

    def told(*words):
        return CliRunner().invoke(app, ["export", *files, "--to", *words])

    assert yaml.safe_load(told("kalibr").stdout) == yaml.safe_load(kalibr_camchain(cameras))
    # The folder of a calibrated rig stands for its cameras.
    folder = {
        "smartview_rig": 1,
        "cameras": {name: f"{name}.yaml" for name in cameras},
        "parameters_of": {name: [] for name in cameras},
        "uncertainty": None,
        "end": "smartview_rig",
    }
    (tmp_path / "rig.joint.yaml").write_text(yaml.safe_dump(folder, sort_keys=False))
    by_folder = CliRunner().invoke(app, ["export", str(tmp_path), "--to", "kalibr"])
    assert by_folder.stdout == told("kalibr").stdout
    nodes = ElementTree.fromstring(told("ros_launch").stdout)
    assert [node.get("name") for node in nodes] == ["left_publisher", "right_publisher"]
    for node, cal in zip(nodes, cameras.values(), strict=True):
        (alone,) = ElementTree.fromstring(ros_launch_file(cal, "tool0", "x"))
        assert node.get("args").split()[:14] == alone.get("args").split()[:14]
    assert "--child-frame-id right_optical_frame" in told("ros").stdout.splitlines()[1]
    assert told("urdf").stdout.count("<origin") == 2
    for words, message in (
        (["opencv"], "--to opencv: expected one calibration; several go to ros, ros_launch, urdf"),
        (["ros", "--child", "camera"], "--child: the frames of several cameras have the names"),
    ):
        refused = told(*words)
        assert refused.exit_code == 2
        assert message in " ".join(refused.stderr.split())
