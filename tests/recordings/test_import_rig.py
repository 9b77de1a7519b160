"""A bag with several cameras becomes the folder of a rig, in which a stop is one view of all."""

import cv2
import numpy as np
import pytest
import yaml
from bag_recordings import numbered_picture, picture_times, recording, stop_poses, tool_pose
from board_scene import run
from detected_sample import detected_sample
from test_bad_bags import FRAMES, refused
from text_files import unwrapped
from written_bags import START, camera_info, compressed, picture, tf, write_bag

import smartview_jax as sv
from smartview_jax.geometry import host_matrices
from smartview_jax.io import read_cameras, sample_folder
from smartview_jax.io.poses import read_poses

POSES = stop_poses(4)
TOPICS = {"left": "/camera/image_raw", "right": "/right/image_raw/compressed"}
K = [[30.0, 0.0, 8.0], [0.0, 31.0, 6.0], [0.0, 0.0, 1.0]]


def right_pictures(times):
    """Pictures of a camera that compresses them, and begins only at the second stop."""
    for t in times:
        if t > 1.5:
            content = cv2.imencode(".jpg", 255 - numbered_picture(t))[1].tobytes()
            yield compressed(TOPICS["right"], t + 0.03, content)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    info = camera_info("/right/camera_info", 0.0, (16, 12), K)
    # The left camera has no picture of the third stop.
    left = [
        message
        for message in recording(POSES)
        if not (message.topic == TOPICS["left"] and 3.0 <= message.seconds - 0.08 < 4.0)
    ]
    messages = [*left, *right_pictures(picture_times(POSES)), info]
    return write_bag(tmp_path_factory.mktemp("bags") / "run", "mcap", messages)


def test_a_stop_has_one_name_for_all_cameras(bag, tmp_path):
    folder = tmp_path / "data"
    written = sv.import_bag(bag, folder, sv.BagSources(image=TOPICS, **FRAMES), "charuco")
    assert written.view_ids == ("0001", "0002", "0003", "0004")
    stamps = yaml.safe_load((folder / "import.yaml").read_text())["stamps_ns"]
    assert [list(views) for views in stamps.values()] == [
        ["0001", "0002", "0004"],
        ["0002", "0003", "0004"],
    ]
    for name, views in stamps.items():
        pictures = {path.name for path in (folder / "images" / name).iterdir()}
        assert pictures == {f"{view}.png" for view in views}
        for view, stamp in views.items():
            assert (stamp - START) / 1e9 // 1.5 == int(view) - 1
    description = yaml.safe_load((folder / "dataset.yaml").read_text())
    assert description["cameras"]["left"] == description["cameras"]["right"]
    assert description["cameras"]["left"] == {"image_size": [16, 12]}
    poses = read_poses(folder, description["poses"], "raise")
    for number, pose in enumerate(host_matrices(poses.poses)):
        np.testing.assert_allclose(pose, tool_pose(POSES, 1.5 * number + 0.5), atol=1e-9)
    assert any(reason.startswith("right: ") for reason in written.left_out)


def test_pictures_are_those_of_the_topics(bag, tmp_path):
    """JPEGs next to PNGs are written as PNGs with the same numbers."""
    folder = tmp_path / "data"
    sv.import_bag(bag, folder, sv.BagSources(image=TOPICS, **FRAMES), "charuco")
    stamps = yaml.safe_load((folder / "import.yaml").read_text())["stamps_ns"]
    for view, stamp in stamps["right"].items():
        shown = cv2.imread(str(folder / "images" / "right" / f"{view}.png"), -1)
        sent = cv2.imencode(".jpg", 255 - numbered_picture((stamp - START) / 1e9 - 0.03))[1]
        np.testing.assert_array_equal(shown, cv2.imdecode(sent, -1))


def test_known_cameras_are_in_a_folder_that_the_calibration_takes(bag, tmp_path):
    written = sv.import_bag(
        bag, tmp_path / "data", sv.BagSources(image=TOPICS, **FRAMES), "charuco"
    )
    cameras = read_cameras(written.camera_file, ("left", "right"))
    assert {name: float(camera.alpha_v) for name, camera in cameras.items()} == {
        "left": 21.0,
        "right": 31.0,
    }


def test_the_folder_is_loaded_as_a_rig(tmp_path):
    """The same pictures as the sample's, hence the same points."""
    sample, count = detected_sample(), 3
    messages = []
    for k, pose in enumerate(host_matrices(sample.base_from_tool)[:count]):
        messages += [tf(2.0 * k + s, "base", "tool0", pose) for s in np.arange(0.0, 1.9, 0.1)]
        pixels = cv2.imread(str(sample_folder() / f"images/{sample.view_ids[k]}.png"), -1)
        kind = "mono8" if pixels.ndim == 2 else "bgr8"
        seen = ["/a"] if k == 0 else ["/a", "/b"]
        messages += [picture(topic, 2.0 * k + 1.0, pixels, kind) for topic in seen]
    bag = write_bag(tmp_path / "run", "ros1", messages)
    sources = sv.BagSources(image={"a": "/a", "b": "/b"}, **FRAMES)
    sv.import_bag(bag, tmp_path / "data", sources, sample_folder() / "dataset.yaml")
    rig = sv.load_rig(tmp_path / "data", keep_detections=False)
    assert [data.view_ids for data in rig.cameras.values()] == [
        ("0001", "0002", "0003"),
        ("0002", "0003"),
    ]
    np.testing.assert_array_equal(rig.cameras["b"].pixels, sample.pixels[1:count])


def test_the_command_names_the_cameras(bag, tmp_path):
    topics = ",".join(f"{name}={topic}" for name, topic in TOPICS.items())
    words = ("--base", "base", "--tool", "tool0", "--target", "charuco", "--image", topics)
    ended = run("import", bag, tmp_path / "data", *words)
    assert ended.exit_code == 0, ended.output
    said = unwrapped(ended.stdout)
    assert f"--camera {tmp_path / 'data' / 'known_cameras'}" in said
    assert "camera_info of right: known_cameras/right.yaml (plumb_bob)" in said
    refusal = run("import", bag, tmp_path / "other", *words[:-1], "left=/a,left=/b")
    assert refusal.exit_code == 2
    assert "with different names" in unwrapped(refusal.stderr)


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"image": {}}, "image: expected a name for each camera"),
        ({"image": {"../left": "/a"}}, "a camera's name has letters, .* found '../left'"),
        ({"image": {"left": "/a", "right": "/a"}}, "expected another topic for each camera"),
        (
            {"image": {"left": "/a"}, "camera_info": {"wrist": "/info"}},
            "camera_info: expected topics by the names of the cameras .left.; found 'wrist'",
        ),
        (
            {"image": {"left": "/a"}, "camera_info": "/info"},
            "names of the cameras .left.; found '/info'",
        ),
        ({"camera_info": {"left": "/info"}}, "names of the cameras .one topic.; found 'left'"),
    ],
)
def test_names_and_topics_that_do_not_agree_are_refused(sources, message):
    with pytest.raises(ValueError, match=message):
        sv.BagSources(**FRAMES, **sources)


def test_what_is_not_common_to_the_cameras_is_refused(bag, tmp_path):
    refused(
        bag,
        tmp_path,
        "camera left: no view is left of 25: 25 within 2.5 s of a motion",
        {"image": TOPICS, **FRAMES},
        choice=sv.MomentChoice(still_for=5.0),
    )
    sources = sv.BagSources(image=TOPICS, **FRAMES)
    with pytest.raises(ValueError, match=r"every: several cameras take .* at different times"):
        sv.import_bag(bag, tmp_path / "data", sources, "charuco", choice=sv.MomentChoice(every=2))
