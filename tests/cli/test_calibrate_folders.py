"""Several folders in one command: a table of all, each with its own files or its own error."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from board_scene import LENS, board_folder, run
from tracked_scene import MOUNT, WORLD, tracked

from smartview_jax import Calibration
from smartview_jax.cli.calibrate_folders import _summary
from smartview_jax.dataset import PoseDataset
from smartview_jax.geometry import as_se3
from smartview_jax.io import PoseSamples, save_dataset, write_easy_handeye
from smartview_jax.simulation import paper_calibration


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two data sets of a name of their own, and an empty folder."""
    root = tmp_path_factory.mktemp("folders")
    for name in ("left", "right"):
        shutil.copytree(board_folder(tmp_path_factory), root / name)
    (root / "empty").mkdir()
    return [root / name for name in ("left", "empty", "right")]


OPTIONS = (*LENS, "--no-held-out", "--jobs", 1)


def test_a_table_shows_all_and_each_has_its_files(folders, tmp_path):
    ended = run("calibrate", *folders, *OPTIONS, "--out", tmp_path)
    assert ended.exit_code == 2
    rows = [line.split() for line in ended.stdout.splitlines() if line.strip()]
    starts = [row[0] for row in rows]
    assert starts.index("left") < starts.index("empty") < starts.index("right")
    assert max(map(len, ended.stdout.splitlines())) <= 80
    assert rows[starts.index("empty")] == ["empty", "error"]
    assert rows[starts.index("left")][1:] == rows[starts.index("right")][1:]
    # Where the lines break depends on the length of the path.
    assert "has neither dataset.yaml" in " ".join(ended.stdout.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["left", "right"]
    saved = Calibration.load(tmp_path / "left" / "calibration.yaml")
    x = 1e3 * float(saved.camera_from_tool.translation()[0])
    assert f" ({x:.1f}, " in ended.stdout
    assert "report.html" in {path.name for path in (tmp_path / "right").iterdir()}
    assert "3 of 3" in ended.stderr


def test_programs_get_a_document_for_each(folders, tmp_path):
    ended = run("calibrate", *folders[:2], *OPTIONS, "--json", "--out", tmp_path)
    left, empty = json.loads(ended.stdout)["data_sets"]
    assert left["data_set"] == "left"
    assert left["error"] is None
    assert left["files"][0] == str(tmp_path / "left" / "calibration.yaml")
    assert "has neither dataset.yaml" in empty["error"]


def test_tracked_poses_have_a_row_in_millimetres(folders, tmp_path):
    """Files of samples and folders of poses next to pictures; a file without samples is named."""
    robot, measured = tracked(3)
    file, broken = tmp_path / "arm.samples", tmp_path / "broken.samples"
    write_easy_handeye(file, PoseSamples(as_se3(robot), as_se3(measured), "eye_in_hand"))
    broken.write_text("samples: []")
    save_dataset(PoseDataset.from_poses(robot, measured), tmp_path / "poses")
    data_sets = (file, broken, tmp_path / "poses", folders[0])
    options = (*OPTIONS, "--mount", "eye_in_hand")
    ended = run("calibrate", *data_sets, *options, "--out", tmp_path / "out")
    assert ended.exit_code == 2
    rows = {row[0]: row[1:] for row in map(str.split, ended.stdout.splitlines()) if row}
    errors = (MOUNT @ np.linalg.inv(robot) @ WORLD - measured)[:, :3, 3]
    rms = np.sqrt(np.mean(np.sum(errors**2, axis=1)))
    assert float(rows["arm"][1]) == pytest.approx(1e3 * rms, rel=0.3)
    assert rows["arm"][1:] == rows["poses"][1:]
    assert rows["arm"][2] == "mm"
    assert rows["left"][2] == "px"
    assert "data set " in ended.stdout, "a heading is cut at 80 columns"
    assert "broken.samples" in ended.stdout.replace("\n", "")
    assert max(map(len, ended.stdout.splitlines()[:8])) <= 80
    published = yaml.safe_load((tmp_path / "out" / "arm" / "hand_eye.calib").read_text())
    expected = np.linalg.inv(MOUNT)[:3, 3]
    translation = [published["transform"]["translation"][axis] for axis in "xyz"]
    np.testing.assert_allclose(translation, expected, atol=3e-3)


def test_results_of_folders_of_one_name_are_not_mixed(folders, tmp_path):
    ended = run("calibrate", folders[0], folders[0] / ".." / "left", "--out", tmp_path)
    assert ended.exit_code == 2
    assert "2 data sets are called left" in ended.stderr.replace("\n", " ")


def test_the_row_of_a_folder_is_of_the_joint_fit_with_its_correction():
    calibration = paper_calibration()
    fit = SimpleNamespace(calibration=calibration, std={}, result=SimpleNamespace(converged=True))
    result = SimpleNamespace(fit=fit, data=SimpleNamespace(view_ids=("a",)), warnings=())
    errors = [{"fitted": {"rms_px": x}, "held_out": {"rms_px": 2.0 * x}} for x in (3.0, 0.4, 2.5)]
    row = _summary(result, {"errors": errors, "left_out_views": []})
    assert (row.rms, row.held_out_rms) == (0.4, 0.8)
