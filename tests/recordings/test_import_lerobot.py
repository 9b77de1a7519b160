"""Data sets of LeRobot, written here by pyarrow and PyAV, become data-set folders."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import yaml
from bag_recordings import duration, moving_pose, stop_poses
from scipy.spatial.transform import Rotation
from text_files import unwrapped
from typer.testing import CliRunner

import smartview_jax as sv
from smartview_jax.cli import app
from smartview_jax.geometry import host_matrices
from smartview_jax.io.poses import read_poses
from smartview_jax.robots import kuka_lwr4

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")
av = pytest.importorskip("av")

FPS = 20
EPISODES = (stop_poses(2, seed=1), stop_poses(3, seed=2))
CAMERA, TOP = "observation.images.wrist", "observation.images.top"
NAMES = ["x", "y", "z", "qx", "qy", "qz", "qw", "gripper"]
POSES = sv.LeRobotSources(pose_format="quaternion_xyzw", names=tuple(NAMES[:7]))
WIDTH, HEIGHT = 64, 48


def times_of(poses):
    return np.arange(round(duration(poses) * FPS)) / FPS


def state_of(pose):
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return [*pose[:3, 3].tolist(), *turn.tolist(), 0.5]


def picture_of(episode, number):
    """A bar whose place tells the number, in the upper half for the first episode."""
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    half = slice(24 * episode, 24 * episode + 24)
    picture[half, 2 * (number % 32) : 2 * (number % 32) + 2] = 255
    return picture


def told_by(picture):
    """The episode and the number, up to a multiple of 32, of a picture."""
    row, column = np.unravel_index(np.argmax(picture[..., 1]), picture.shape[:2])
    return int(row // 24), int(column // 2)


def write_video(path, pictures):
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "5"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())


def write_table(path, columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pa.table(columns), path)


def rows_of(episode, state=state_of, names=NAMES):
    times = times_of(EPISODES[episode])
    states = [state(moving_pose(EPISODES[episode], time)) for time in times.tolist()]
    assert len(states[0]) == len(names)
    return {
        "episode_index": np.full(len(times), episode),
        "frame_index": np.arange(len(times)),
        "timestamp": times.astype(np.float32),
        "observation.state": states,
    }


def joined(tables):
    return {key: [value for table in tables for value in table[key]] for key in tables[0]}


def write_dataset(folder, version, dtype="video", state=state_of, names=NAMES):
    """A data set as LeRobot lays it out: a file for each episode, or one for all."""
    shared = version == "v3.0"
    tables = [rows_of(episode, state, names) for episode in range(len(EPISODES))]
    pictures = [
        [picture_of(episode, k) for k in range(len(times_of(poses)))]
        for episode, poses in enumerate(EPISODES)
    ]
    if dtype == "image":
        for table, shown in zip(tables, pictures, strict=True):
            files = [cv2.imencode(".png", picture)[1].tobytes() for picture in shown]
            table[CAMERA] = [{"bytes": file, "path": None} for file in files]
    if shared:
        write_table(folder / "data/chunk-000/file-000.parquet", joined(tables))
        begins = np.cumsum([0, *(len(shown) / FPS for shown in pictures)])[:-1]
        places = {
            "episode_index": np.arange(len(EPISODES)),
            f"videos/{CAMERA}/chunk_index": np.zeros(len(EPISODES), int),
            f"videos/{CAMERA}/file_index": np.zeros(len(EPISODES), int),
            f"videos/{CAMERA}/from_timestamp": begins,
        }
        write_table(folder / "meta/episodes/chunk-000/file-000.parquet", places)
        template = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if dtype == "video":
            path = template.format(video_key=CAMERA, chunk_index=0, file_index=0)
            write_video(folder / path, [picture for shown in pictures for picture in shown])
    else:
        template = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        for k, (table, shown) in enumerate(zip(tables, pictures, strict=True)):
            write_table(folder / f"data/chunk-000/episode_{k:06d}.parquet", table)
            path = template.format(episode_chunk=0, video_key=CAMERA, episode_index=k)
            if dtype == "video":
                write_video(folder / path, shown)
    features = {
        CAMERA: {"dtype": dtype, "shape": [HEIGHT, WIDTH, 3], "names": ["height", "width", "c"]},
        "observation.state": {"dtype": "float32", "shape": [len(names)], "names": names},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    info = {
        "codebase_version": version,
        "fps": FPS,
        "chunks_size": 1000,
        "video_path": template if dtype == "video" else None,
        "features": features,
    }
    (folder / "meta").mkdir(exist_ok=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


@pytest.fixture(scope="module", params=[("v2.1", "video"), ("v3.0", "video"), ("v3.0", "image")])
def dataset(request, tmp_path_factory):
    return write_dataset(tmp_path_factory.mktemp("lerobot"), *request.param)


def views_of(folder, first_episode=0):
    """The pose, the picture, and the episode and time of each view."""
    content = yaml.safe_load((folder / "dataset.yaml").read_text())
    poses = read_poses(folder, content["poses"], "raise")
    stamps = yaml.safe_load((folder / "import.yaml").read_text())["stamps_ns"]
    actual = []
    for view, pose in zip(poses.view_ids, host_matrices(poses.poses), strict=True):
        # Another episode begins a minute after the end of the one before it.
        later, time = divmod(1e-9 * stamps[view], 50.0)
        end = times_of(EPISODES[first_episode])[-1]
        episode, time = (
            (first_episode + 1, 1e-9 * stamps[view] - 60.0 - end)
            if later
            else (
                first_episode,
                time,
            )
        )
        shown = cv2.imread(str(folder / "images" / f"{view}.png"))
        actual.append((pose, shown, episode, time))
    return actual


def test_one_picture_of_every_stop_of_every_episode(dataset, tmp_path):
    written = sv.import_lerobot(dataset, tmp_path / "data", POSES, "charuco")
    views = views_of(tmp_path / "data")
    assert written.view_ids == ("0001", "0002", "0003", "0004", "0005")
    for pose, shown, episode, time in views:
        np.testing.assert_allclose(pose, moving_pose(EPISODES[episode], time), atol=1e-6)
        assert told_by(shown) == (episode, round(time * FPS) % 32)
        assert 0.25 <= time % 1.5 <= 0.75
    assert written.target_is_template
    assert sum(written.left_out.values()) == sum(len(times_of(p)) for p in EPISODES) - 5


def test_episodes_may_be_chosen_and_all_pictures_taken(dataset, tmp_path):
    sources = sv.LeRobotSources(
        pose_format="quaternion_xyzw", names=tuple(NAMES[:7]), episodes=(1,)
    )
    choice = sv.MomentChoice(every=10)
    written = sv.import_lerobot(dataset, tmp_path / "data", sources, "charuco", choice=choice)
    assert len(written.view_ids) == 9
    for k, (pose, shown, episode, _) in enumerate(views_of(tmp_path / "data", 1)):
        assert episode == 1
        np.testing.assert_allclose(pose, moving_pose(EPISODES[1], k * 10 / FPS), atol=1e-6)
        assert told_by(shown) == (1, 10 * k % 32)
    assert "in motion" in written.notes[-1]


@pytest.fixture(scope="module")
def two_cameras(tmp_path_factory):
    """A camera with videos, and one whose inverted pictures are JPEGs in the rows."""
    folder = write_dataset(tmp_path_factory.mktemp("lerobot"), "v2.1")
    for episode in range(len(EPISODES)):
        table = rows_of(episode)
        pictures = [255 - picture_of(episode, k) for k in range(len(table["timestamp"]))]
        files = [cv2.imencode(".jpg", picture)[1].tobytes() for picture in pictures]
        table[TOP] = [{"bytes": file, "path": None} for file in files]
        write_table(folder / f"data/chunk-000/episode_{episode:06d}.parquet", table)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][TOP] = {**info["features"][CAMERA], "dtype": "image"}
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def test_several_cameras_become_the_folder_of_a_rig(two_cameras, tmp_path):
    folder = tmp_path / "data"
    words = ["import", str(two_cameras), str(folder), "--target", "charuco"]
    words += ["--pose-format", "quaternion_xyzw", "--state-names", ",".join(NAMES[:7])]
    told = CliRunner().invoke(app, [*words, "--image", f"wrist={CAMERA},top={TOP}"])
    assert told.exit_code == 0, told.output
    assert "5 views" in unwrapped(told.output)
    described = yaml.safe_load((folder / "dataset.yaml").read_text())
    size = {"image_size": [WIDTH, HEIGHT]}
    assert described["cameras"] == {"wrist": size, "top": size}
    poses = host_matrices(read_poses(folder, described["poses"], "raise").poses)
    stamps = yaml.safe_load((folder / "import.yaml").read_text())["stamps_ns"]
    assert stamps["wrist"] == stamps["top"]
    assert described["pictures"]["pattern"] == "images/{camera}/{view}.png"
    for view, pose in zip(stamps["top"], poses, strict=True):
        wrist, top = (
            cv2.imread(str(folder / "images" / name / f"{view}.png")) for name in ("wrist", "top")
        )
        episode, number = told_by(wrist)
        assert told_by(255 - top) == (episode, number)
        # A stop lasts for a second and a half, 30 frames.
        close = [moving_pose(EPISODES[episode], (number + 32 * k) / FPS) for k in range(3)]
        assert min(np.abs(pose - other).max() for other in close) < 1e-6


def test_cameras_that_cannot_be_told_apart_are_refused(two_cameras, tmp_path):
    with pytest.raises(ValueError, match="image: expected another feature for each camera"):
        dataclasses.replace(POSES, image={"a": CAMERA, "b": CAMERA})
    with pytest.raises(ValueError, match=f"found {CAMERA}, {TOP}; name one of them, or each"):
        sv.import_lerobot(two_cameras, tmp_path / "data", POSES, "charuco")


def joints_of(pose):
    """Some joint readings that stand when the robot does, degrees, with a gripper."""
    return [*np.round(100.0 * pose[0, :3], 9), *np.round(100.0 * pose[1, :3], 9), 12.0, 50.0]


def test_joint_readings_have_the_stated_unit(tmp_path):
    names = [f"joint{k}.pos" for k in range(7)] + ["gripper.pos"]
    folder = write_dataset(tmp_path / "set", "v2.1", "image", joints_of, names)
    arm = kuka_lwr4()
    asked = ["--arm", "kuka_lwr4", "--angle-unit", "deg", "--target", "charuco"]
    asked += ["--state-names", ",".join(names[:7])]
    told = CliRunner().invoke(app, ["import", str(folder), str(tmp_path / "data"), *asked])
    assert told.exit_code == 0, told.output
    assert "5 views" in unwrapped(told.output)
    pose, _, episode, time = views_of(tmp_path / "data")[0]
    readings = np.deg2rad(joints_of(moving_pose(EPISODES[episode], time))[:7])
    np.testing.assert_allclose(pose, host_matrices(arm.base_from_tool(readings)), atol=1e-6)
    sources = sv.LeRobotSources(arm=arm, angle_unit="rad", names=tuple(names[:7]))
    with pytest.raises(ValueError, match="too large for radians"):
        sv.import_lerobot(folder, tmp_path / "rad", sources, "charuco")
    assert not (tmp_path / "rad").exists()


def test_joint_readings_in_percent_are_refused(tmp_path):
    """LeRobot's default for some arms: whole steps of an encoder between the ends of a motion."""
    counts = np.array([2476, 2400, 2192, 2340, 4095, 1890, 2001])

    def percent(pose):
        share = 0.5 + 0.1 * pose[:2, :4].ravel()[:7]
        return [*(np.round(share * counts) / counts * 200.0 - 100.0).tolist(), 50.0]

    names = [f"joint{k}.pos" for k in range(7)] + ["gripper.pos"]
    folder = write_dataset(tmp_path / "set", "v2.1", "image", percent, names)
    for unit in ("deg", "rad"):
        sources = sv.LeRobotSources(arm=kuka_lwr4(), angle_unit=unit, names=tuple(names[:7]))
        with pytest.raises(ValueError, match=r"set: observation.state: .*percent.*use_degrees"):
            sv.import_lerobot(folder, tmp_path / "data", sources, "charuco")
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("sources", "message"),
    [
        ({"names": ("x", "y", "height")}, "no number is called 'height'; there are x, y, z"),
        ({}, r"expected 7 numbers of a pose \(x, y, z, .*\), found x, y, z, qx"),
        ({"image": TOP}, f"expected pictures {TOP!r}, found"),
        ({"state": "action"}, "a feature of numbers called 'action', found observation.state"),
        ({"names": tuple(NAMES[:7]), "episodes": (5,)}, "no episode 5; there are 2"),
        ({"names": ("y", "x", "z", "gripper", "qx", "qy", "qz")}, "quaternion"),
    ],
)
def test_what_is_missing_is_named(dataset, tmp_path, sources, message):
    told = sv.LeRobotSources(pose_format="quaternion_xyzw", **sources)
    with pytest.raises(ValueError, match=message):
        sv.import_lerobot(dataset, tmp_path / "data", told, "charuco")
    assert not (tmp_path / "data").exists()


def test_contradictions_are_refused():
    with pytest.raises(ValueError, match="expected an arm, for joint readings, or the format"):
        sv.LeRobotSources()
    with pytest.raises(ValueError, match="angle_unit: expected deg or rad"):
        sv.LeRobotSources(arm=kuka_lwr4())
    with pytest.raises(ValueError, match=r"angle_unit: expected .*, found 'percent'"):
        sv.LeRobotSources(arm=kuka_lwr4(), angle_unit="percent")


def test_a_picture_that_is_none_is_named(tmp_path):
    folder = write_dataset(tmp_path / "set", "v2.1", "image")
    table = rows_of(1)
    table[CAMERA] = [{"bytes": b"no picture", "path": None}] * len(table["timestamp"])
    write_table(folder / "data/chunk-000/episode_000001.parquet", table)
    with pytest.raises(ValueError, match="wrist: view 0003: expected a picture as PNG or JPEG"):
        sv.import_lerobot(folder, tmp_path / "data", POSES, "charuco")
    assert not (tmp_path / "data").exists()


def test_broken_data_sets_are_named(tmp_path):
    folder = write_dataset(tmp_path / "set", "v2.1")
    first = folder / "videos/chunk-000" / CAMERA / "episode_000000.mp4"
    whole = first.read_bytes()

    def refused(error, message):
        with pytest.raises(error, match=message):
            sv.import_lerobot(folder, tmp_path / "data", POSES, "charuco")
        assert not (tmp_path / "data").exists()

    first.write_bytes(b"no video")
    refused(ValueError, r"episode_000000\.mp4: no readable video")
    first.unlink()
    refused(FileNotFoundError, r"episode_000000\.mp4: no such video")
    write_video(first, [picture_of(0, k) for k in range(20)])
    refused(ValueError, r"episode_000000\.mp4: the video ends before")
    first.write_bytes(whole)
    (folder / "data/chunk-000/episode_000001.parquet").write_bytes(b"no table")
    refused(ValueError, r"episode_000001\.parquet: no readable table")
    info = folder / "meta/info.json"
    write_table(folder / "data/chunk-000/episode_000001.parquet", rows_of(1))
    described = info.read_text()
    info.write_text(described.replace("{episode_chunk", "{part"))
    refused(ValueError, r"info\.json: video_path: expected a pattern of episode_chunk, video_key")
    info.write_text(described.replace('"chunks_size": 1000', '"chunks_size": "many"'))
    refused(ValueError, r"chunks_size: expected a number, found 'many'")
    info.write_text(described.replace("v2.1", "v1.6"))
    refused(ValueError, r"codebase_version: expected v2\.0, v2\.1, v3\.0, found 'v1\.6'")
    info.write_text("{")
    refused(ValueError, "not readable as JSON")
