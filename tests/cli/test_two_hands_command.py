"""`smartview check`, `calibrate` and `export` of a camera on one hand and a target on another."""

import json

import numpy as np
import pytest
from two_hands_scene import TRANSFORMS, two_hands
from typer.testing import CliRunner

from smartview_jax import Calibration, save_dataset
from smartview_jax.cli import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("two_hands")
    save_dataset(two_hands(0).data, place / "data")
    two_hands(0).calibration.save(place / "camera.yaml")
    return place


def run(*words):
    result = CliRunner().invoke(app, list(map(str, words)))
    assert result.exit_code == 0, result.output
    return result.stdout


def test_check_says_how_both_hands_moved(folder):
    text = run("check", folder / "data", "--camera", folder / "camera.yaml")
    assert "hand_to_hand" in text
    assert "hand with the camera: the tool moved by" in text
    assert "hand with the target: largest rotation between two views" in text
    assert "camera and robot agree: ready for smartview calibrate" in text


def test_calibrate_prints_and_writes_all_three_transforms(folder):
    words = ("--noise", "trusted", "--no-held-out", "--camera", folder / "camera.yaml", "--json")
    out = folder / "out"
    document = json.loads(run("calibrate", folder / "data", *words, "--out", out))
    assert set(document["transforms"]) == set(TRANSFORMS)
    found = Calibration.load(out / "calibration.yaml")
    truth = two_hands(0).calibration
    for name in TRANSFORMS:
        off = found.transforms[name].translation() - truth.transforms[name].translation()
        assert np.abs(off).max() < 3e-3
    assert "base_from_other_base" in (out / "report.html").read_text()


def test_the_camera_on_its_hand_is_exported(folder):
    text = run("export", folder / "camera.yaml", "--to", "ros")
    assert "tool0" in text
