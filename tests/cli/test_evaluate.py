"""Figures on new pictures, from the command alone, against the library's."""

import dataclasses
import json

import numpy as np
import pytest
from board_scene import BOARD, VIEWS, calibrated_board, run
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.cli.load import load_named
from smartview_jax.cli.options import BadViews
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.io import save_dataset
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.simulation import random_scene, simulate


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    return calibrated_board(tmp_path_factory)


@pytest.fixture(scope="module")
def truth(board):
    return Calibration.load(board.data / "truth.yaml")


@pytest.fixture(scope="module")
def poses():
    """Of pictures that the calibration was not fitted to."""
    return random_scene(1, VIEWS, BOARD.points).base_from_tool


def unseen(truth, poses):
    noise = {"translation_noise": 1e-4, "rotation_noise": 1.7e-4}
    data = simulate(truth, poses, BOARD.points, seed=3, **noise).data
    return dataclasses.replace(data, target=BOARD)


@pytest.fixture(scope="module")
def data(truth, poses):
    return unseen(truth, poses)


@pytest.fixture(scope="module")
def folder(data, tmp_path_factory):
    path = tmp_path_factory.mktemp("evaluate") / "unseen"
    save_dataset(data, path)
    return path


@pytest.fixture(scope="module")
def evaluated(board, folder, tmp_path_factory):
    """The result of one run with all options, and its page."""
    page = tmp_path_factory.mktemp("evaluate") / "page.html"
    options = ("--compare", board.data / "truth.yaml", "--out", page)
    ended = run("evaluate", board.calibration, folder, *options)
    assert ended.exit_code == 0, ended.output
    return ended.output, page.read_text()


def test_the_errors_are_those_of_the_library(board, evaluated, data):
    output, _ = evaluated
    errors = reprojection_errors(Calibration.load(board.calibration), data)
    assert f"{errors.mean:.2f} +- {errors.std:.2f} px" in output
    assert f"{errors.rms:.2f} px RMS, {errors.rms_mm:.2f} mm at the target" in output
    assert "120, 8" in output


def test_two_calibrations_stand_side_by_side(evaluated):
    """The first one says what error it expected; the truth says nothing of its own."""
    lines = evaluated[0].splitlines()
    assert lines[0].split() == ["calibration", "truth"]
    found, _ = next(x for x in lines if "ideal: 1" in x).split()[-2:]
    assert 0.5 < float(found) < 2.0


def test_the_page_has_the_figures(evaluated):
    _, page = evaluated
    assert page.count("<img src=") == 2
    assert "Fig. 7" in page


def test_a_target_that_was_moved_is_found_again(board, truth, poses, tmp_path):
    moved = truth.base_from_world.wxyz_xyz.at[4].add(0.01)
    there = dataclasses.replace(truth, holder_from_world=SE3(moved))
    save_dataset(unseen(there, poses), tmp_path / "moved")
    words = ("evaluate", board.calibration, tmp_path / "moved")
    assert _rms(run(*words)) > 20.0
    assert _rms(run(*words, "--moved")) < 3.0


def test_a_missing_file_is_named(folder):
    ended = run("evaluate", "nowhere.yaml", folder)
    assert ended.exit_code == 2
    assert "nowhere.yaml" in ended.output


def _rms(ended):
    assert ended.exit_code == 0, ended.output
    line = next(x for x in ended.output.splitlines() if x.startswith("RMS"))
    return float(line.split()[-2])


def test_the_calibrations_own_pictures_are_recognised(board, evaluated, truth, poses, tmp_path):
    """All of them, and one of them among new ones under another name."""
    own = run("evaluate", board.calibration, board.data)
    assert own.exit_code == 0, own.output
    assert f"{VIEWS} of {VIEWS} pictures were used to fit this calibration" in own.stdout
    assert "used to fit this calibration" not in evaluated[0]
    mixed = unseen(truth, poses)
    fitted, _ = load_named(board.data, BadViews.MASK, print)
    pixels = np.asarray(mixed.pixels).copy()
    pixels[3] = np.asarray(fitted.pixels)[5]
    visible = np.asarray(mixed.visible).copy()
    visible[3] = np.asarray(fitted.visible)[5]
    mixed = dataclasses.replace(mixed, pixels=to_device(pixels), visible=to_device(visible))
    save_dataset(mixed, tmp_path / "mixed")
    ended = run("evaluate", board.calibration, tmp_path / "mixed", "--json")
    assert json.loads(ended.stdout)["fitted_views"] == [mixed.view_ids[3]]
