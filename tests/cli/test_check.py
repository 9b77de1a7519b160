"""What `smartview check` says of data that can be calibrated; `test_every_verb` has the others."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest
from board_scene import BOARD, board_folder, run, single_tag_folder
from detected_sample import detected_sample
from fit_scenes import scene_of
from text_files import unwrapped

from smartview_jax import Rig
from smartview_jax.cli.check import _checked, _report_without_doubted_views
from smartview_jax.geometry import host_exponentials, host_transforms
from smartview_jax.rig_pipeline import reference_camera, usable_view_counts
from smartview_jax.robots import HandPoses


def test_good_data_can_begin(tmp_path_factory):
    ended = run("check", board_folder(tmp_path_factory))
    assert ended.exit_code == 0, ended.output
    assert "board: 8 views, eye_in_hand" in unwrapped(ended.output)
    assert "usable views: 8; take more" in unwrapped(ended.output)
    assert re.search(
        r"the tool moved by \(\d+, \d+, \d+\) mm along x, y, z", unwrapped(ended.output)
    )
    assert "camera and robot agree" in unwrapped(ended.output)


@pytest.fixture
def folder(tmp_path_factory, tmp_path):
    """A copy of the data set without its pictures' poses, and its rows of poses."""
    for path in board_folder(tmp_path_factory).iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def repeat_rows(folder, rows):
    """Give each view the pose of another row."""
    header, *lines = (folder / "poses.csv").read_text().splitlines()
    numbers = [line.split(",", 1) for line in lines]
    changed = [f"{name},{numbers[row][1]}" for (name, _), row in zip(numbers, rows, strict=True)]
    (folder / "poses.csv").write_text("\n".join([header, *changed]) + "\n")


def test_poses_that_were_not_read_again_are_named(folder):
    repeat_rows(folder, [0, 0, 2, 3, 4, 4, 6, 7])
    ended = run("check", folder)
    assert ended.exit_code == 0, ended.output
    assert unwrapped(ended.output).count("though the picture moved by") == 2
    assert "usable views: 6; take more" in unwrapped(ended.output)


def test_equal_poses_are_a_problem(folder):
    repeat_rows(folder, [3] * 8)
    ended = run("check", folder)
    assert ended.exit_code == 1
    assert "problem: all 8 robot poses are equal: the pose was not read again" in unwrapped(
        ended.output
    )


def test_two_rows_that_were_exchanged_are_doubted(folder):
    repeat_rows(folder, [0, 1, 2, 6, 4, 5, 3, 7])
    ended = run("check", folder)
    assert ended.exit_code == 0, ended.output
    assert "doubt: view 3: its rotation differs from the robot's by " in unwrapped(ended.output)
    assert "doubt: view 6: its rotation differs from the robot's by " in unwrapped(ended.output)
    # Without these two the others agree, and move as far.
    assert unwrapped(ended.output).count("doubt: ") == 2
    assert "camera and robot agree, apart from these doubts: " in unwrapped(ended.output)


def test_the_motion_of_two_hands_is_compared_with_their_bases_where_the_fit_put_them():
    data, rng = detected_sample(), np.random.default_rng(0)
    sizes = [0.1, 0.1, 0.1, 0.5, 0.5, 0.5]
    first, second = host_exponentials(rng.normal(0.0, sizes, (2, data.view_count, 6)))
    bases, hand, board = host_exponentials(rng.normal(size=(3, 6)))
    camera = hand @ np.linalg.inv(first) @ bases @ second @ board
    camera[[0, 2]] = camera[[2, 0]]
    hands = HandPoses(host_transforms(first), host_transforms(second))
    fit = SimpleNamespace(
        views=range(1, data.view_count),
        conventions=SimpleNamespace(suspicious_views=((2, "its rotation differs"),)),
        calibration=SimpleNamespace(base_from_other_base=host_transforms(bases)),
        step2=SimpleNamespace(camera_from_world=host_transforms(camera)),
    )
    data = dataclasses.replace(data, hands=hands, mount="hand_to_hand")
    report = _report_without_doubted_views(data, fit)
    assert report.length_ratio == pytest.approx(1.0, abs=1e-9)
    assert max(report.closure_error) < 1e-7


def test_a_target_of_twice_its_size_is_doubted(folder):
    described = (folder / "dataset.yaml").read_text()
    assert "0.008" in described
    (folder / "dataset.yaml").write_text(described.replace("0.008", "0.016"))
    ended = run("check", folder)
    assert ended.exit_code == 0, ended.output
    assert re.search(
        r"is the target 0\.(49|50?)\d* times as large as stated\?", unwrapped(ended.output)
    )


def test_a_target_in_another_unit_is_named_for_it(folder):
    """Inches written as centimetres."""
    described = (folder / "dataset.yaml").read_text()
    size = str(BOARD.square)
    assert size in described
    (folder / "dataset.yaml").write_text(described.replace(size, f"{BOARD.square / 2.54:.7f}"))
    ended = run("check", folder)
    assert ended.exit_code == 0, ended.output
    assert "the target's points like inches where centimetres are" in unwrapped(ended.output)
    assert "measure it" not in unwrapped(ended.output)


def test_a_single_tag_can_begin_with_a_known_camera(tmp_path):
    single_tag_folder(tmp_path)
    assert "4 points seen, 6 needed" in unwrapped(run("check", tmp_path / "tag").output)
    told = run("check", tmp_path / "tag", "--camera", tmp_path / "camera.yaml")
    assert told.exit_code == 0, told.output
    assert "camera and robot agree" in unwrapped(told.output)


def test_few_views_of_a_known_camera_need_another_camera():
    scene = scene_of(0)
    few = scene.data.select([0, 1])
    rig = Rig({"left": scene.data, "right": few}, {"left": "table", "right": "table"})
    counts = usable_view_counts(rig, {"right": scene.calibration.camera})
    assert counts.pop("right") == 2
    assert reference_camera(rig, "right", counts) == "left"
    apart = Rig(rig.cameras, {"left": "table", "right": "wall"})
    assert reference_camera(apart, "right", counts) is None
    with_help = _checked(few, "right", scene.calibration.camera, "left")
    assert with_help.problems == ()
    assert with_help.lines[-1].endswith("from the target that left sees")
    for camera, reference in ((None, "left"), (scene.calibration.camera, None)):
        (problem,) = _checked(few, "right", camera, reference).problems
        assert "needs at least 3 views" in problem


def test_check_stops_where_calibrate_does_unless_views_are_left_out(folder):
    lines = (folder / "poses.csv").read_text().splitlines()
    lines[3] = ",".join([lines[3].split(",")[0], *["nan"] * lines[3].count(",")])
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    stopped = run("calibrate", folder, "--out", folder / "out")
    assert stopped.exit_code == 2
    reason = stopped.output.split("smartview: ")[-1].strip()
    checked = run("check", folder)
    assert checked.exit_code == 1
    assert "problem: smartview calibrate stops at this: " in unwrapped(checked.output)
    assert unwrapped(reason)[:60] in unwrapped(checked.output)
    assert "robot and camera agree" not in unwrapped(checked.output)
    assert run("check", folder, "--bad-views", "mask").exit_code == 0
