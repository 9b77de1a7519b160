"""Data sets whose robot logged its poses while it moved, read from their folders."""

import numpy as np
import pytest
import yaml
from text_files import edit

import smartview_jax as sv
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_pose_log
from smartview_jax.io.csv_tables import read_table, write_table
from smartview_jax.robots import Trajectory
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
    _, *columns = read_table(tmp_path / "poses.csv", ())[0]
    rows = [list(row.values()) for row in read_table(tmp_path / "poses.csv", ())]
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
        ("times.csv", "499.9", "900.0", r"view 0: its time, 900\.1 s, is not within"),
        ("times.csv", "\n1,", "\n0,", r"times\.csv: view 0 has more than one row"),
        ("times.csv", "499.9", "soon", r"times\.csv: view 0: time is 'soon', not a number"),
        (
            "poses.csv",
            "\n501.0,",
            "\n500.0,",
            r"poses\.csv: trajectory: time 2 is 500 s, not after",
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
    with pytest.raises(ValueError, match="time_offset: it needs picture_times"):
        sv.load_dataset(folder)
