"""A chessboard in eight simulated views, calibrated by the command once for all tests.

The scenes of `fit_scenes` have as many views, points and lens parameters, some after padding: one
set of programs fits them all.
"""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from once_a_run import made_once
from typer.testing import CliRunner

from smartview_jax.cli import app
from smartview_jax.io import save_dataset
from smartview_jax.simulation import random_scene, random_target_scene
from smartview_jax.targets import Chessboard

BOARD = Chessboard(5, 3, 0.008)

LENS = ("--lens", "radial")

VIEWS = 8


class CalibratedBoard(NamedTuple):
    """What `smartview calibrate --json` left.

    Attributes:
        data: the folder of the data set, with the truth in truth.yaml.
        out: the folder of the results.
        stdout: the document that was printed.
        stderr: what was said meanwhile.
    """

    data: Path
    out: Path
    stdout: str
    stderr: str

    @property
    def calibration(self):
        """The file of the calibration, with its uncertainty."""
        return self.out / "calibration.yaml"


def run(*words):
    """The command's result in this process."""
    return CliRunner().invoke(app, [str(word) for word in words])


def board_folder(tmp_path_factory):
    """The simulated data set, which is only to be read."""

    def make(path):
        noise = {"translation_noise": 1e-4, "rotation_noise": np.deg2rad(0.01)}
        scene = random_target_scene(2, VIEWS, BOARD, **noise)
        save_dataset(scene.data, path)
        scene.calibration.save(path / "truth.yaml", source="simulated")

    return made_once(tmp_path_factory, "board", make)


def single_tag_folder(path):
    """Write a data set with four corners in each view, as of a tag, and its camera.

    Returns:
        The scene.
    """
    scene = random_scene(1, VIEWS, BOARD.points)
    others = np.setdiff1d(np.arange(15), [0, 4, 10, 14])
    pixels = scene.data.pixels.at[:, others].set(np.nan)
    save_dataset(dataclasses.replace(scene.data, pixels=pixels, target=BOARD), path / "tag")
    scene.calibration.save(path / "camera.yaml")
    return scene


def calibrated_board(tmp_path_factory):
    """The data set's calibration, with held-out errors; the files are only to be read."""
    data = board_folder(tmp_path_factory)

    def make(path):
        ended = run("calibrate", data, *LENS, "--out", path, "--json")
        assert ended.exit_code == 0, ended.output
        (path / "said.json").write_text(json.dumps([ended.stdout, ended.stderr]))

    out = made_once(tmp_path_factory, "calibrated_board", make)
    return CalibratedBoard(data, out, *json.loads((out / "said.json").read_text()))
