"""Figures on new pictures, from the command alone, against those of the library."""

import dataclasses

import pytest
from typer.testing import CliRunner

from smartview_jax import Calibration, fit_joint
from smartview_jax.cli import app
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.io import save_dataset
from smartview_jax.simulation import random_scene
from smartview_jax.targets import Chessboard

BOARD = Chessboard(9, 6, 0.004)


@pytest.fixture(scope="module")
def scene():
    return random_scene(1, 16, BOARD.points, translation_noise=1e-4)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """Eight views to calibrate with, saved as a calibration, and eight others as a data set."""
    path = tmp_path_factory.mktemp("evaluate")
    fit = fit_joint(scene.data.select(range(8)), scene.calibration, field=None)
    fit.save(path / "calibration.yaml")
    unseen = dataclasses.replace(scene.data.select(range(8, 16)), target=BOARD)
    save_dataset(unseen, path / "unseen")
    return path


def evaluated(folder, *options):
    words = ["evaluate", str(folder / "calibration.yaml"), str(folder / "unseen"), *options]
    return CliRunner().invoke(app, words)


def test_the_errors_are_those_of_the_library(folder, scene):
    calibration = Calibration.load(folder / "calibration.yaml")
    errors = reprojection_errors(calibration, scene.data.select(range(8, 16)))
    run = evaluated(folder)
    assert run.exit_code == 0, run.output
    assert f"{errors.mean:.2f} +- {errors.std:.2f} px" in run.output
    assert f"{errors.rms:.2f} px RMS, {errors.rms_mm:.2f} mm at the target" in run.output
    assert "432, 8" in run.output


def test_the_calibration_says_what_it_expected(folder):
    line = next(x for x in evaluated(folder).output.splitlines() if "1 is honest" in x)
    assert 0.5 < float(line.split()[-1]) < 2.0


def test_two_calibrations_stand_side_by_side(folder, scene):
    scene.calibration.save(folder / "truth.yaml")
    run = evaluated(folder, "--beside", str(folder / "truth.yaml"))
    assert run.exit_code == 0, run.output
    assert run.output.splitlines()[0].split() == ["calibration", "truth"]


def test_a_target_that_was_moved_is_found_anew(folder, scene, tmp_path):
    data = scene.data.select(range(8, 16))
    moved = scene.calibration.base_from_world.wxyz_xyz.at[4].add(0.01)
    there = dataclasses.replace(
        scene.calibration, holder_from_world=type(scene.calibration.base_from_world)(moved)
    )
    pixels = there.project(data.base_from_tool, data.points)[0]
    shifted = dataclasses.replace(data, pixels=pixels, target=BOARD)
    save_dataset(shifted, tmp_path / "moved")
    words = ["evaluate", str(folder / "calibration.yaml"), str(tmp_path / "moved")]
    assert _rms(CliRunner().invoke(app, words)) > 20.0
    assert _rms(CliRunner().invoke(app, [*words, "--moved"])) < 3.0


def test_the_page_has_the_figures(folder, tmp_path):
    run = evaluated(folder, "--out", str(tmp_path / "page.html"))
    assert run.exit_code == 0, run.output
    page = (tmp_path / "page.html").read_text()
    assert page.count("<img src=") == 2
    assert "Fig. 7" in page


def test_a_missing_file_is_named(folder):
    run = CliRunner().invoke(app, ["evaluate", "nowhere.yaml", str(folder / "unseen")])
    assert run.exit_code == 2
    assert "nowhere.yaml" in run.output


def _rms(run):
    assert run.exit_code == 0, run.output
    line = next(x for x in run.output.splitlines() if x.startswith("RMS"))
    return float(line.split()[-2])
