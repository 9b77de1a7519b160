"""Bags of three formats become data-set folders that are read as any other."""

import sys

import cv2
import numpy as np
import pytest
import yaml
from bag_recordings import (
    FLANGE,
    SHOULDER,
    moving_pose,
    numbered_picture,
    picture_times,
    recording,
    robot_motion,
    stop_poses,
    tool_pose,
)
from board_scene import run
from detected_sample import detected_sample
from text_files import unwrapped
from tracked_scene import MOUNT, tracked
from written_bags import (
    FORMATS,
    START,
    compressed,
    header,
    joint_state,
    picture,
    pose_stamped,
    tf,
    write_bag,
)

import smartview_jax as sv
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.dataset import PoseDataset
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_pose_log, read_camera, sample_folder
from smartview_jax.io.poses import read_poses
from smartview_jax.robots import kuka_lwr4

POSES = stop_poses(3)
FRAMES = sv.BagSources(base="base", tool="tool0")


@pytest.fixture(scope="module", params=FORMATS)
def bag(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bags")
    return write_bag(folder / "run", request.param, recording(POSES))


def stamps_of(folder):
    """Seconds of the views by their names."""
    stamps = yaml.safe_load((folder / "import.yaml").read_text())["stamps_ns"]
    return {view: 1e-9 * (stamp - START) for view, stamp in stamps.items()}


def poses_of(folder):
    """Poses of the views by their names."""
    content = yaml.safe_load((folder / "dataset.yaml").read_text())
    poses = read_poses(folder, content["poses"], "raise")
    return dict(zip(poses.view_ids, host_matrices(poses.poses), strict=True))


def test_one_picture_of_every_stop_with_its_pose(bag, tmp_path):
    told = []
    written = sv.import_bag(bag, tmp_path / "data", FRAMES, "charuco", progress=told.append)
    folder, stamps = tmp_path / "data", stamps_of(tmp_path / "data")
    assert written.view_ids == tuple(stamps) == ("0001", "0002", "0003")
    for view, pose in poses_of(folder).items():
        np.testing.assert_allclose(pose, tool_pose(POSES, stamps[view]), atol=1e-9)
        shown = cv2.imread(str(folder / "images" / f"{view}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(shown, numbered_picture(stamps[view]))
        assert stamps[view] % 1.5 >= 0.25
    assert sum(written.left_out.values()) + 3 == len(picture_times(POSES))
    camera = read_camera(written.camera_file)
    assert (float(camera.alpha_v), float(camera.lens.k2)) == (21.0, -0.2)
    assert written.target_is_template
    text = (folder / "dataset.yaml").read_text()
    assert "MEASURE" in text
    assert yaml.safe_load(text)["camera"]["image_size"] == [16, 12]
    assert any("/camera/image_raw 80 ms" in note for note in written.notes)
    assert told[0].startswith(f"reading {bag.name}: 1 of ")


def test_every_second_picture_with_the_log_of_the_motion(bag, tmp_path):
    choice = sv.MomentChoice(every=2)
    written = sv.import_bag(bag, tmp_path / "data", FRAMES, "charuco", choice=choice)
    stamps = list(stamps_of(tmp_path / "data").values())
    np.testing.assert_allclose(stamps, picture_times(POSES)[::2][: len(stamps)], atol=1e-6)
    assert written.left_out["because one in 2 is taken"] in (11, 12)
    log = load_pose_log(tmp_path / "data")
    assert log.view_ids == written.view_ids
    expected = [tool_pose(POSES, seconds) for seconds in stamps]
    # The log is interpolated by splines, which overshoot a corner of the motion.
    np.testing.assert_allclose(host_matrices(log.poses()), expected, atol=2e-3)
    np.testing.assert_allclose(
        log.trajectory.base_from_tool[7], tool_pose(POSES, 7 / 50), atol=1e-9
    )


def test_the_samples_pictures_are_the_same_data_from_a_bag(tmp_path):
    """Hence the same calibration."""
    sample, count = detected_sample(), 4
    messages = []
    for k, pose in enumerate(host_matrices(sample.base_from_tool)[:count]):
        messages += [tf(2.0 * k + s, "base", "tool0", pose) for s in np.arange(0.0, 1.9, 0.1)]
        pixels = cv2.imread(str(sample_folder() / f"images/{sample.view_ids[k]}.png"), -1)
        kind = "mono8" if pixels.ndim == 2 else "bgr8"
        messages.append(picture("/image", 2.0 * k + 1.0, pixels, kind))
    bag = write_bag(tmp_path / "run", "mcap", messages)
    written = sv.import_bag(bag, tmp_path / "data", FRAMES, sample_folder() / "dataset.yaml")
    data = sv.load_dataset(tmp_path / "data", keep_detections=False)
    assert not written.target_is_template
    assert data.target == sample.target
    np.testing.assert_array_equal(data.pixels, sample.pixels[:count])
    np.testing.assert_allclose(
        host_matrices(data.base_from_tool), host_matrices(sample.base_from_tool)[:count], atol=1e-9
    )


def test_the_bytes_of_compressed_pictures_are_kept(tmp_path):
    content = cv2.imencode(".jpg", np.tile(np.arange(16, dtype=np.uint8), (12, 1)))[1].tobytes()
    topic = "/camera/image_raw/compressed"
    pictures = [compressed(topic, seconds, content) for seconds in picture_times(POSES)]
    bag = write_bag(tmp_path / "run", "ros1", [*robot_motion(POSES), *pictures])
    sv.import_bag(bag, tmp_path / "data", FRAMES, "charuco")
    files = sorted((tmp_path / "data" / "images").iterdir())
    assert [file.suffix for file in files] == [".jpg"] * 3
    assert {file.read_bytes() for file in files} == {content}


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize("by", ["topic", "frame"])
def test_poses_of_a_tag_become_tracked_poses_that_calibrate(tmp_path, by, mount):
    robot, measured = tracked(0, mount=mount)
    messages = []
    for k, (pose, tag) in enumerate(zip(robot, measured, strict=True)):
        times = 2.0 * k + np.arange(0.0, 1.9, 0.1)
        if by == "topic":
            messages += [pose_stamped("/tcp", seconds, pose, "base") for seconds in times]
            messages.append(pose_stamped("/tag", 2.0 * k + 1.0, tag))
        else:
            messages += [tf(seconds, "base", "tool0", pose) for seconds in times]
            messages.append(tf(2.0 * k + 1.0, "camera", "tag_7", tag))
    bag = write_bag(tmp_path / "run", "sqlite3", messages)
    sources = (
        sv.BagSources(robot="/tcp", tag="/tag")
        if by == "topic"
        else sv.BagSources(base="base", tool="tool0", tag="tag_7")
    )
    sv.import_bag(bag, tmp_path / "data", sources, mount=mount)
    data = sv.load_dataset(tmp_path / "data")
    assert isinstance(data, PoseDataset)
    assert data.mount == mount
    np.testing.assert_allclose(host_matrices(data.base_from_tool), robot, atol=1e-9)
    np.testing.assert_allclose(host_matrices(data.camera_from_world), measured, atol=1e-9)
    if (by, mount) == ("frame", "eye_in_hand"):
        # As in `test_pose_fit`, whose programs are used.
        camera = Camera(900.0, 900.0, 320.0, 240.0, Pinhole(), (640, 480))
        fit = sv.fit_poses(data, camera=camera, field=None)
        mount_error = host_matrices(fit.calibration.camera_from_mount) - MOUNT
        assert np.abs(mount_error[:3]).max() < 3e-3


def test_joint_readings_give_poses_by_the_arm(tmp_path):
    """Their order in the messages is another one, and messages of a gripper come between."""
    arm, count = kuka_lwr4(), 3
    names = tuple(f"j{k}" for k in range(arm.joint_count))
    readings = np.random.default_rng(0).uniform(-1.0, 1.0, (count, arm.joint_count))
    messages = []
    for k, row in enumerate(readings):
        for s in np.arange(0.0, 1.9, 0.1):
            messages.append(joint_state("/joints", 2.0 * k + s, names[::-1], row[::-1]))
            messages.append(joint_state("/joints", 2.0 * k + s + 0.01, ["finger"], [0.1]))
        messages.append(picture("/image", 2.0 * k + 1.0, numbered_picture(0.0)))
    bag = write_bag(tmp_path / "run", "ros1", messages)
    sources = sv.BagSources(joints="/joints", joint_names=names, arm=arm)
    sv.import_bag(bag, tmp_path / "data", sources, "charuco")
    table = np.loadtxt(tmp_path / "data" / "joints.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 1:], readings, atol=1e-12)
    assert "poses" not in yaml.safe_load((tmp_path / "data" / "dataset.yaml").read_text())


def test_the_command_takes_names_and_links_from_a_file_of_the_robot(tmp_path):
    """The bag has no tf: the kinematics from link to link gives the poses."""
    pytest.importorskip("urdf_parser_py")
    links = {"base": "", "upper": "base", "fore": "upper", "tool0": "fore", "finger": "tool0"}
    joints = "".join(
        f'<joint name="to_{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.1 0 0.3" rpy="0 {0.8 * k} 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        for k, (child, parent) in enumerate(links.items())
        if parent
    )
    bodies = "".join(f'<link name="{link}"/>' for link in links)
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{bodies}{joints}</robot>')
    names, readings = ["to_finger", "to_fore", "to_tool0", "to_upper"], [0.4, 0.2, 0.3, 0.1]
    times = np.arange(0.0, 2.0, 0.1)
    states = [joint_state("/joint_states", t, names, readings) for t in times]
    shot = picture("/image", 1.0, numbered_picture(0.0))
    bag = write_bag(tmp_path / "run", "mcap", [*states, shot])
    words = f"--base base --tool tool0 --joints joint_states --arm {tmp_path / 'arm.urdf'}".split()
    file = next(bag.glob("*.mcap"))
    ended = run("import", file, tmp_path / "data", *words, "--target", "charuco")
    assert ended.exit_code == 0, ended.output
    assert "joints: to_upper, to_fore, to_tool0 of /joint_states" in ended.stdout
    assert "robot: poses by the arm's kinematics" in ended.stdout
    table = np.loadtxt(tmp_path / "data" / "joints.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[1:], [0.1, 0.2, 0.3], atol=1e-12)


def test_transforms_that_are_no_poses_are_left_out_and_said(tmp_path):
    """Some drivers publish zeros before they are ready."""
    bad = tf(0.005, "shoulder", "flange", np.eye(4))
    for number in bad.fields["transforms"][0]["transform"]["rotation"]:
        bad.fields["transforms"][0]["transform"]["rotation"][number] = 0.0
    bag = write_bag(tmp_path / "run", "mcap", [bad, *recording(POSES)])
    written = sv.import_bag(bag, tmp_path / "data", FRAMES, "charuco")
    assert "tf: 1 transforms of flange in shoulder are no poses: left out" in written.notes


def test_pictures_whose_stamps_are_out_of_order_are_told(tmp_path):
    """Two pictures have each other's stamps, as from a driver that stamps them at random."""
    messages = recording(POSES)
    pictures = [k for k, message in enumerate(messages) if message.topic == "/camera/image_raw"]
    first, second = pictures[4], pictures[9]
    stamps = [messages[k].fields["header"] for k in (second, first)]
    for k, stamp in zip((first, second), stamps, strict=True):
        messages[k] = messages[k]._replace(fields=messages[k].fields | {"header": stamp})
    bag = write_bag(tmp_path / "run", "mcap", messages)
    written = sv.import_bag(bag, tmp_path / "data", FRAMES, "charuco")
    (text,) = [note for note in written.notes if "go back" in note]
    # The pictures are 0.2 s apart; the early one has the stamp of the fifth after it.
    assert "/camera/image_raw go back 2 times from picture to picture, by up to 0.8 s" in text
    (clock,) = [note for note in written.notes if "recorded after" in note]
    assert "/camera/image_raw 80 ms (-920 to 1080)" in clock
    sources = sv.BagSources(base="base", tool="tool0", received=True)
    written = sv.import_bag(bag, tmp_path / "received", sources, "charuco")
    assert not [note for note in written.notes if "go back" in note]


def test_times_of_recording_instead_of_stamps(tmp_path):
    """The camera's computer has another date."""
    messages = [
        message._replace(fields=message.fields | {"header": header(k - 1e9, "camera")})
        if message.topic == "/camera/image_raw"
        else message
        for k, message in enumerate(recording(POSES))
    ]
    bag = write_bag(tmp_path / "run", "mcap", messages)
    with pytest.raises(ValueError, match="do the computers' clocks differ"):
        sv.import_bag(bag, tmp_path / "data", FRAMES, "charuco")
    assert not (tmp_path / "data").exists()
    sources = sv.BagSources(base="base", tool="tool0", received=True)
    sv.import_bag(bag, tmp_path / "data", sources, "charuco")
    for view, pose in poses_of(tmp_path / "data").items():
        seconds = stamps_of(tmp_path / "data")[view]
        expected = SHOULDER @ moving_pose(POSES, seconds) @ FLANGE
        np.testing.assert_allclose(pose, expected, atol=1e-9)


def test_the_command_says_what_was_left_out_and_what_to_do_next(tmp_path):
    bag = write_bag(tmp_path / "run", "mcap", recording(POSES))
    words = [
        "--base",
        "base",
        "--tool",
        "tool0",
        "--target",
        "charuco",
        "--still-within",
        "0.5,0.2",
    ]
    ended = run("import", bag, tmp_path / "data", *words)
    assert ended.exit_code == 0, ended.output
    said = ended.stdout
    for part in (
        "pictures: 22 of /camera/image_raw",
        "robot: tf from base - shoulder - flange - tool0",
        "camera_info: camera_info.yaml (plumb_bob)",
        "of a stop that is a view already",
        "3 views; next steps:",
        "1. measure the target",
        f"3. smartview calibrate {tmp_path / 'data'} (or, with the camera held: --camera",
    ):
        assert part in unwrapped(said)
    again = run("import", bag, tmp_path / "data", *words)
    assert (again.exit_code, "exists already" in again.stderr) == (2, True)


def test_without_rosbags_the_command_says_what_to_install(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "run", "mcap", recording(POSES))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    ended = run("import", bag, tmp_path / "data", "--robot", "/tcp", "--target", "charuco")
    assert ended.exit_code == 2
    said = " ".join(ended.stderr.split())
    assert said == "smartview: reading bags of ROS needs rosbags: pip install 'smartview-jax[ros]'"
    assert not (tmp_path / "data").exists()
