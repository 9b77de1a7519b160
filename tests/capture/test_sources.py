"""Cameras, video files, folders that fill up, and poses that a person types."""

import os
import time

import cv2
import numpy as np
import pytest

from smartview_jax.capture import (
    OpenCVCamera,
    PictureFolder,
    Reopened,
    SourceLostError,
    TypedRobot,
    VideoFile,
    parse_pose,
)
from smartview_jax.capture.motion import STEP_ANGLE, STEP_LENGTH, straight_steps
from smartview_jax.geometry import (
    POSE_CODECS,
    host_exponentials,
    host_logarithms,
    host_matrices,
    host_transforms,
    pose_codec,
)

POSE = host_exponentials(np.array([0.6, -0.2, 0.4, 0.3, -0.5, 1.2]))


def test_a_video_file_gives_its_frames_and_then_the_last_one(tmp_path):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(3):
        writer.write(np.full((48, 64, 3), 60 * k, np.uint8))
    writer.release()
    video = VideoFile(path)
    means = [round(float(video.read().mean()) / 60.0) for _ in range(5)]
    assert means == [0, 1, 2, 2, 2]
    video.close()
    with pytest.raises(SourceLostError, match="cannot be opened"):
        VideoFile(tmp_path / "nothing.avi")


def test_a_camera_that_is_not_there_is_lost():
    with pytest.raises(SourceLostError, match="camera 97 cannot be opened"):
        OpenCVCamera(97)


def test_the_newest_complete_picture_of_a_folder_is_read(tmp_path):
    source = PictureFolder(tmp_path)
    with pytest.raises(SourceLostError, match="no picture yet"):
        source.read()
    for k, age in enumerate((9.0, 5.0, 0.0)):
        path = tmp_path / f"{k}.png"
        cv2.imwrite(str(path), np.full((4, 5), 100 + k, np.uint8))
        os.utime(path, (time.time() - age,) * 2)
    # The last one has just been changed: it may not be complete.
    assert source.read()[0, 0] == 101
    os.utime(tmp_path / "2.png", (time.time() - 1.0,) * 2)
    assert source.read()[0, 0] == 102
    with pytest.raises(SourceLostError, match="no such folder"):
        PictureFolder(tmp_path / "gone")


def test_a_source_is_opened_again_after_some_time():
    opened = []

    class Source:
        is_continuous = True

        def read(self):
            return np.zeros((1, 1), np.uint8)

        def close(self):
            raise OSError("it is broken")

    def open_source():
        opened.append(time.monotonic())
        if len(opened) == 1:
            raise OSError("not yet")
        return Source()

    source = Reopened(open_source, retry_seconds=0.05)
    for _ in range(2):
        with pytest.raises(SourceLostError, match="not yet"):
            source.get()
    assert len(opened) == 1
    time.sleep(0.06)
    assert source.get() is source.get()
    assert source.trouble == ""
    source.lose(OSError("cable"))
    assert (source.trouble, len(opened)) == ("cable", 2)


@pytest.mark.parametrize("name", sorted(POSE_CODECS))
def test_a_pasted_pose_of_every_format_is_read(name):
    codec = pose_codec(name)
    row = codec.encode(host_transforms(POSE), *codec.units)
    named = ", ".join(f"{c} {x:.9f}" for c, x in zip(codec.columns, row, strict=True))
    plain = "\t".join(f"{x:.9f}" for x in row)
    for text in (f"{{{named}}}", f"p[{plain}]", f"({plain})\n"):
        np.testing.assert_allclose(parse_pose(text, codec), POSE, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3", r"expected 6 numbers \(x, y, z, A, B, C, kuka_abc\), found 3"),
        ("812,5 0,0 310,0 0,0 0,0 0,0", "found 12"),
        ("", "found 0"),
        ("nan 0 0 0 0 0", "found 5"),
    ],
)
def test_a_text_that_is_no_pose_is_refused(text, words):
    with pytest.raises(ValueError, match=words):
        parse_pose(text, pose_codec("kuka_abc"))


def test_a_typed_pose_holds_for_one_view():
    robot = TypedRobot("kuka_abc")
    with pytest.raises(SourceLostError, match="type the robot's pose: x, y, z, A, B, C"):
        robot.pose()
    robot.type("X 100 Y 200 Z 300 A 0 B 0 C 0")
    np.testing.assert_allclose(robot.pose()[:3, 3], [0.1, 0.2, 0.3])
    robot.forget()
    with pytest.raises(SourceLostError):
        robot.pose()


def test_the_steps_of_a_motion_are_short_and_straight():
    end = POSE @ host_exponentials(np.array([0.1, 0.0, -0.05, 0.0, 1.0, 0.4]))
    steps = straight_steps(POSE, end)
    np.testing.assert_array_equal(steps[-1], end)
    poses = np.concatenate([POSE[None], steps])
    between = host_logarithms(np.linalg.inv(poses[:-1]) @ poses[1:])
    shifts = np.diff(poses[:, :3, 3], axis=0)
    assert np.linalg.norm(shifts, axis=1).max() <= STEP_LENGTH + 1e-12
    assert np.linalg.norm(between[:, 3:], axis=1).max() <= STEP_ANGLE + 1e-12
    np.testing.assert_allclose(shifts, np.broadcast_to(shifts[0], shifts.shape), atol=1e-12)
    np.testing.assert_allclose(host_matrices(host_transforms(steps)), steps, atol=1e-12)
    assert len(straight_steps(POSE, POSE)) == 1
