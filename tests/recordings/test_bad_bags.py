"""What is missing, contradictory or damaged in a bag is named, and nothing is written."""

import numpy as np
import pytest
from bag_recordings import numbered_picture, picture_times, recording, robot_motion, stop_poses
from written_bags import FORMATS, camera_info, compressed, joint_state, picture, tf, write_bag

import smartview_jax as sv
from smartview_jax.robots import kuka_lwr4

POSES = stop_poses(2)
FRAMES = {"base": "base", "tool": "tool0"}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bags") / "run", "mcap", recording(POSES))


def refused(bag, folder, message, sources=FRAMES, target="charuco", **options):
    """Import a bag, which has to be refused with a message that names it."""
    with pytest.raises((ValueError, OSError), match=message) as error:
        sv.import_bag(bag, folder / "data", sv.BagSources(**sources), target, **options)
    assert str(bag) in str(error.value)
    assert [path.name for path in folder.iterdir() if "data" in path.name] == []


ARM = {"joints": "/tf", "arm": kuka_lwr4(), "joint_names": tuple("abcdefg")}


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"image": "/nowhere"}, r"image: no topic /nowhere; the bag has /camera/camera_info \(sen"),
        ({"image": "/tf"}, r"image: topic /tf has messages of tf2_msgs/msg/TFMessage; expected"),
        ({"camera_info": "/tf"}, "camera_info: topic /tf has messages of"),
        ({"tool": "flansch"}, "no frame flansch in tf; there are base, flange, shoulder, tool0"),
        ({"tool": "shoulder"}, "base - shoulder: all transforms are static"),
        (ARM, "joints: topic /tf has messages of .*; expected sensor_msgs/msg/JointState"),
        ({"base": None, "tool": None, "robot": "/tf"}, "robot: topic /tf has messages of"),
        ({"base": None, "tool": None, "robot": "/tcp"}, "robot: no topic /tcp"),
    ],
)
def test_what_is_not_there_is_named_with_what_there_is(bag, tmp_path, sources, message):
    refused(bag, tmp_path, message, FRAMES | sources)


@pytest.mark.parametrize(
    ("tag", "message"),
    [
        ("tag_7", "no frame tag_7 in tf; there are base, .*; no topic has this name; there are /c"),
        ("/tf", "for a pose in tf name the tag's frame"),
        ("/camera/camera_info", "its messages have no poses; if the detector publishes"),
        ("shoulder", "base - shoulder: expected measurements over time in tf"),
    ],
)
def test_a_tag_that_is_not_there_is_named(bag, tmp_path, tag, message):
    refused(bag, tmp_path, message, FRAMES | {"tag": tag}, None)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"base": "base"}, "expected both frames or none"),
        ({}, "the robot's pose: expected the frames"),
        (FRAMES | {"robot": "/tcp"}, "robot: expected a topic of poses, or the frames"),
        (FRAMES | {"joints": "/joint_states"}, "joints and arm: expected both or none"),
        (FRAMES | {"tag": "a", "image": "b"}, "expected no image"),
        (FRAMES | {"tag_id": 3}, "expected with a tag only"),
    ],
)
def test_contradictions_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        sv.BagSources(**given)


@pytest.mark.parametrize("form", FORMATS)
def test_a_bag_that_was_cut_off_is_named(tmp_path, form):
    path = write_bag(tmp_path / "run", form, recording(POSES))
    file = path if path.is_file() else next(path.glob("run*"))
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    refused(path, tmp_path, "run(.bag)?: (not readable as a bag of ROS|damaged)")


def test_a_folder_without_bags_is_named(tmp_path):
    (tmp_path / "text.bag").write_text("no bag")
    (tmp_path / "table.csv").write_text("")
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("nowhere.bag", "no such bag"),
        ("text.bag", "not readable as a bag of ROS"),
        ("table.csv", "expected a file .bag, .db3, .mcap, or the folder"),
        ("empty", "expected a file .bag, .db3, .mcap, or the folder"),
    ):
        refused(tmp_path / name, tmp_path, message)


def test_which_of_several_topics_has_to_be_said(tmp_path):
    second = [picture("/right/image", t, numbered_picture(t)) for t in picture_times(POSES)]
    bag = write_bag(tmp_path / "run", "sqlite3", [*recording(POSES), *second])
    refused(bag, tmp_path, "of several cameras; there are /camera/image_raw, /right/image")


def test_a_robot_that_never_stands_is_said_with_how_far_it_moves(tmp_path):
    motion = []
    for t in np.arange(0.0, 4.0, 0.02):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * t
        motion.append(tf(t, "base", "tool0", pose))
    pictures = [picture("/image", t, numbered_picture(t)) for t in (0.5, 1.5, 9.0)]
    bag = write_bag(tmp_path / "run", "mcap", [*motion, *pictures])
    refused(
        bag,
        tmp_path,
        "no view is left of 3: 1 before or after the robot's poses; 2 within 0.25 s of a motion of "
        "the robot; the robot never stands for 0.5 s within 0.1 mm and 0.0229 degrees; at least it "
        "moves by 50 mm and 0 degrees: allow more",
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoding": "32FC1"}, "encoding '32FC1': expected one of mono8"),
        ({"width": 200}, "200 x 12 px of mono8 in rows of 16 bytes: expected 2400 bytes, found 1"),
        ({"data": np.zeros(5, np.uint8)}, "expected 192 bytes, found 5"),
    ],
)
def test_a_wrong_picture_is_named_by_its_time(tmp_path, changes, message):
    pictures = [picture("/image", t, numbered_picture(t), **changes) for t in picture_times(POSES)]
    bag = write_bag(tmp_path / "run", "ros1", [*robot_motion(POSES), *pictures])
    refused(bag, tmp_path, f"topic /image: picture at 17000000.*: {message}")


def test_pictures_of_two_sizes_are_refused(tmp_path):
    pictures = [
        picture("/image", t, numbered_picture(t)[: 12 if t < 1.5 else 10])
        for t in picture_times(POSES)
    ]
    bag = write_bag(tmp_path / "run", "ros1", [*robot_motion(POSES), *pictures])
    refused(bag, tmp_path, "a .png of 16 x 10 px and 8 bits, but the first is a .png of 16 x 12")


def test_a_video_stream_is_no_picture(tmp_path):
    pictures = [compressed("/image", t, b"\0\0\1h264", "h264") for t in picture_times(POSES)]
    bag = write_bag(tmp_path / "run", "mcap", [*robot_motion(POSES), *pictures])
    refused(bag, tmp_path, "format 'h264': expected a picture as PNG or JPEG")


@pytest.mark.parametrize(
    ("info", "note"),
    [
        ({"K": np.zeros((3, 3))}, "not calibrated"),
        ({"size": (640, 480)}, "for pictures of 640 x 480 px, but these have 16 x 12: not used"),
        ({"model": "spherical"}, "spherical with 0 coefficients is not read"),
        ({"D": [0.1] * 12, "model": "rational_polynomial"}, "with 12 coefficients is not read"),
    ],
)
def test_a_camera_that_is_not_known_is_left_out_and_said(tmp_path, info, note):
    K = [[20.0, 0.0, 8.0], [0.0, 21.0, 6.0], [0.0, 0.0, 1.0]]
    message = camera_info("/camera/camera_info", 0.0, **{"size": (16, 12), "K": K} | info)
    bag = write_bag(tmp_path / "run", "mcap", [*recording(POSES)[:-1], message])
    written = sv.import_bag(bag, tmp_path / "data", sv.BagSources(**FRAMES), "charuco")
    assert written.camera_file is None
    assert not (tmp_path / "data" / "camera_info.yaml").exists()
    assert any(note in text for text in written.notes)


def test_joints_that_are_not_there_are_named(tmp_path):
    states = [joint_state("/joints", t, ["a", "b"], [0.0, 1.0]) for t in picture_times(POSES)]
    bag = write_bag(tmp_path / "run", "mcap", [*recording(POSES), *states])
    message = "no message has positions of the joints a, b, c, d, e, f, g; there are a, b"
    refused(bag, tmp_path, message, ARM | {"joints": "/joints"})
    message = "joint_names: expected 7 different names, .*, found none; the topic has a, b"
    refused(bag, tmp_path, message, ARM | {"joints": "/joints", "joint_names": ()})


def test_a_folder_with_files_is_not_overwritten(bag, tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "mine.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="data: exists already; nothing is overwritten"):
        sv.import_bag(bag, tmp_path / "data", sv.BagSources(**FRAMES), "charuco")
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["mine.txt"]


def test_a_target_that_is_not_there_is_named(bag, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"target: expected one of chessboard, .*nowhere"):
        sv.import_bag(bag, tmp_path / "data", sv.BagSources(**FRAMES), "nowhere.yaml")
    (tmp_path / "empty.yaml").write_text("rows: 3\n")
    with pytest.raises(ValueError, match=r"empty.yaml: expected an entry target"):
        sv.import_bag(bag, tmp_path / "data", sv.BagSources(**FRAMES), tmp_path / "empty.yaml")
    with pytest.raises(ValueError, match="expected for pictures, and not with poses of a tag"):
        sv.import_bag(bag, tmp_path / "data", sv.BagSources(**FRAMES))
