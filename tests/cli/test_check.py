"""What `smartview check` says of data that can be calibrated, and of data that cannot."""

import dataclasses
import shutil

import pytest
from typer.testing import CliRunner

from smartview_jax.cli import app
from smartview_jax.io import save_dataset
from smartview_jax.simulation import random_scene
from smartview_jax.targets import Chessboard


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    board = Chessboard(9, 6, 0.004)
    scene = random_scene(1, 9, board.points)
    path = tmp_path_factory.mktemp("data") / "board"
    save_dataset(dataclasses.replace(scene.data, target=board), path)
    return path


def checked(folder):
    return CliRunner().invoke(app, ["check", str(folder)])


def test_good_data_can_begin(folder):
    run = checked(folder)
    assert run.exit_code == 0, run.output
    assert "board: 9 views, eye_in_hand" in run.output
    assert "usable views: 9; take more" in run.output
    assert "camera and robot agree" in run.output


def test_poses_the_wrong_way_round_are_a_problem(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    text = (copy / "dataset.yaml").read_text()
    (copy / "dataset.yaml").write_text(text.replace("base_from_tool", "tool_from_base"))
    run = checked(copy)
    assert run.exit_code == 1
    assert "problem: " in run.output
    assert "tool_from_base" in run.output or "inverse" in run.output


def test_a_missing_folder_is_named(tmp_path):
    run = checked(tmp_path / "nowhere")
    assert run.exit_code == 2
    assert "nowhere" in run.output
