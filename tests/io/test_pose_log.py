"""Data sets whose robot logged its poses while it moved, read from their folders."""

import numpy as np
import pytest
import yaml
from shared_data import shared_case
from text_files import edit

import smartview_jax as sv
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_pose_log, load_view_pictures
from smartview_jax.io.csv_tables import read_table, write_table
from smartview_jax.robots import Trajectory, times_in_gaps
from smartview_jax.simulation import random_target_scene
from smartview_jax.targets import Chessboard

VIEWS, FIRST, STEP = 6, 500.0, 0.5


def edit_yaml(path, change):
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))


@pytest.fixture
def scene():
    return random_target_scene(1, VIEWS, Chessboard(5, 4, 0.006), pixel_noise=0.1)


@pytest.fixture
def folder(scene, tmp_path):
    """The poses of a data set as a log with a time for each; a picture was taken at each of them.

    The camera's clock is 0.1 s behind the robot's.
    """
    sv.save_dataset(scene.data, tmp_path)
    _, *columns = read_table(tmp_path / "poses.csv", ()).rows[0]
    rows = [list(row.values()) for row in read_table(tmp_path / "poses.csv", ()).rows]
    times = FIRST + STEP * np.arange(VIEWS)
    logged = [[time, *row[1:]] for time, row in zip(times, rows, strict=True)]
    write_table(tmp_path / "poses.csv", ["time", *columns], logged)
    pictures = [[row[0], time - 0.1] for time, row in zip(times, rows, strict=True)]
    write_table(tmp_path / "times.csv", ["view", "time"], pictures)
    edit_yaml(
        tmp_path / "dataset.yaml",
        lambda content: content["poses"].update(picture_times="times.csv", time_offset=0.1),
    )
    return tmp_path


def test_the_poses_are_those_at_the_corrected_times(folder, scene):
    data = sv.load_dataset(folder)
    assert data.view_ids == scene.data.view_ids
    np.testing.assert_allclose(
        host_matrices(data.base_from_tool), host_matrices(scene.data.base_from_tool), atol=1e-9
    )
    log = load_pose_log(folder)
    assert log is not None
    assert log.time_offset == 0.1
    np.testing.assert_allclose(log.picture_times, FIRST - 0.1 + STEP * np.arange(VIEWS))
    # Without the offset the poses are those between two of the log.
    edit_yaml(folder / "dataset.yaml", lambda content: content["poses"].update(time_offset=-0.1))
    (folder / "times.csv").write_text((folder / "times.csv").read_text().replace("499.9", "500.3"))
    expected = Trajectory.of(log.trajectory.times, log.trajectory.base_from_tool)
    shifted = np.array([500.2, *(log.picture_times[1:] - 0.1)])
    np.testing.assert_allclose(
        host_matrices(sv.load_dataset(folder).base_from_tool), expected.at(shifted), atol=1e-9
    )


def test_a_folder_with_a_pose_for_every_view_has_no_log(scene, tmp_path):
    sv.save_dataset(scene.data, tmp_path)
    assert load_pose_log(tmp_path) is None


@pytest.mark.parametrize(
    ("table", "old", "new", "message"),
    [
        (
            "times.csv",
            "499.9",
            "900.0",
            r"times\.csv: view 0: taken 400\.1 s after .* outside the log",
        ),
        ("times.csv", "\n1,", "\n0,", r"times\.csv: view 0 has more than one row"),
        ("times.csv", "499.9", "soon", r"times\.csv: view 0: time is 'soon', not a number"),
        (
            "poses.csv",
            "\n501.0,",
            "\n500.0,",
            r"poses\.csv: two different poses at time 500, 0 s after the first",
        ),
        ("poses.csv", "\n501.0,", "\nnan,", r"poses\.csv: view row 3: time is nan"),
        ("poses.csv", "time,", "view,", "expected the columns time; missing time"),
    ],
)
def test_a_wrong_table_is_named(folder, table, old, new, message):
    edit(folder / table, old, new)
    with pytest.raises(ValueError, match=message):
        sv.load_dataset(folder)


def test_an_offset_without_the_pictures_times_is_refused(folder):
    edit_yaml(folder / "dataset.yaml", lambda content: content["poses"].pop("picture_times"))
    with pytest.raises(ValueError, match="time_offset: needs picture_times"):
        sv.load_dataset(folder)


def rows(path):
    header, *lines = path.read_text().splitlines()
    return header, lines


def test_rows_of_a_recorder_are_sorted_and_counted_once(folder):
    expected = sv.load_dataset(folder)
    header, lines = rows(folder / "poses.csv")
    shuffled = [lines[k] for k in (0, 2, 1, 2, 3, 5, 4, 4)]
    (folder / "poses.csv").write_text("\n".join([header, *shuffled]) + "\n")
    edit_yaml(folder / "dataset.yaml", lambda content: content["poses"].pop("rows"))
    data = sv.load_dataset(folder)
    np.testing.assert_array_equal(data.base_from_tool.wxyz_xyz, expected.base_from_tool.wxyz_xyz)
    assert "poses.csv: rows were not sorted by time; sorted them" in data.notes
    assert "poses.csv: 2 repeated rows were dropped" in data.notes


def test_clocks_of_two_time_zones_are_named(folder):
    header, lines = rows(folder / "times.csv")
    late = [f"{view},{float(time) + 3600.0}" for view, time in (line.split(",") for line in lines)]
    (folder / "times.csv").write_text("\n".join([header, *late]) + "\n")
    with pytest.raises(
        ValueError, match=r"times\.csv: no picture .* from 3600 to 3602\.5 s"
    ) as told:
        sv.load_dataset(folder)
    assert "are the clocks 1 hour apart" in str(told.value)


def test_pictures_of_a_longer_recording_are_not_said_to_need_an_offset(folder):
    header, lines = rows(folder / "times.csv")
    views = [line.split(",")[0] for line in lines]
    late = [f"{view},{1e4 + 1e3 * k}" for k, view in enumerate(views)]
    (folder / "times.csv").write_text("\n".join([header, *late]) + "\n")
    with pytest.raises(ValueError, match="the pictures span more time than the log") as told:
        sv.load_dataset(folder)
    assert "Add" not in str(told.value)


def moving_log(step=0.02, duration=30.0):
    """A robot that moves for 2 s and stands for 1 s, again and again."""
    times = 1e9 + np.arange(0.0, duration, step)
    moved = np.cumsum((times - 1e9) % 3.0 < 2.0) * step
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = 0.1 * np.stack([np.sin(moved), np.cos(2.0 * moved), moved], axis=1)
    return times, poses


def in_gaps(times, poses, lost, asked):
    kept = ~((times - 1e9 > lost[0]) & (times - 1e9 < lost[1]))
    return times_in_gaps(Trajectory.of(times[kept], poses[kept]), 1e9 + np.asarray(asked))


def test_a_gap_is_judged_by_the_motion_of_its_log():
    times, poses = moving_log()
    # A long gap in motion; the pictures before, at its end and after it are good.
    actual = in_gaps(times, poses, (10.01, 13.01), [9.99, 11.5, 13.02, 13.03])
    np.testing.assert_array_equal(actual, [False, True, False, False])
    # One row is missing, or the robot stood still.
    assert not in_gaps(times, poses, (10.01, 10.03), [10.02]).any()
    assert not in_gaps(times, poses, (11.05, 11.95), [11.5]).any()
    # Robots are logged at any rate: a slow log has no gaps of its own.
    assert not in_gaps(*moving_log(0.5), (-2.0, -1.0), [10.2, 11.3]).any()
    # A gap longer than the rest of its log has nothing to be judged by.
    assert in_gaps(times, poses, (1.0, 29.0), [11.5]).all()


def test_a_picture_in_the_gap_of_a_shared_log_is_masked():
    data = sv.load_dataset(shared_case("log_gap"), keep_detections=False)
    (masked,) = [(view, why) for view, why in data.masked_views if "too long to interpolate" in why]
    assert masked[0] == "08"
    assert "taken 41.5 s after the robot's log began" in masked[1]


def test_a_view_in_a_gap_is_not_modelled():
    with pytest.raises(ValueError, match=r"times\.csv: view 08: taken 41\.5 s .*remove this view"):
        load_view_pictures(shared_case("log_gap"))
