"""With --json stdout is one document with the library's numbers."""

import json
import sys

import numpy as np
import pytest
from board_scene import VIEWS, calibrated_board, run

from smartview_jax import Calibration, fit_staged, load_dataset
from smartview_jax.evaluation import compare, reprojection_errors, rms_interval
from smartview_jax.geometry import host_matrices
from smartview_jax.joint import load_estimate
from smartview_jax.version import __version__


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    return calibrated_board(tmp_path_factory)


@pytest.fixture(scope="module")
def folder(board):
    return board.data


@pytest.fixture(scope="module")
def calibrated(board):
    """The document of the calibration, and where its files are."""
    # Everything that people watch meanwhile is on the other stream.
    assert "fold 1 of 5" in board.stderr
    return document(board), board.out


def document(ended, verb=None):
    content = json.loads(ended.stdout)
    assert content["version"] == __version__
    assert verb in (None, content["smartview"])
    return content


def pose(entry):
    """A transform's matrix from its entry, by the formula of the unit quaternion."""
    w, x, y, z = entry["quaternion_wxyz"]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2.0 * w * cross + 2.0 * cross @ cross
    matrix[:3, 3] = entry["translation"]
    return matrix


def test_the_transforms_are_those_of_the_file(calibrated):
    content, out = calibrated
    saved = Calibration.load(out / "calibration.yaml")
    for name in ("camera_from_tool", "base_from_world"):
        found = pose(content["transforms"][name])
        np.testing.assert_allclose(found, host_matrices(getattr(saved, name)), atol=1e-9)
    assert content["camera"]["alpha_u"] == pytest.approx(float(saved.camera.alpha_u), abs=1e-6)
    assert content["mount"] == "eye_in_hand"
    assert content["files"][0] == str(out / "calibration.yaml")
    assert content["run"] in (out / "report.html").read_text()


def test_the_uncertainty_is_that_of_the_file(calibrated):
    content, out = calibrated
    saved = load_estimate(out / "calibration.yaml")
    stds = dict(zip(saved.parameter_names, np.sqrt(np.diagonal(saved.covariance)), strict=True))
    stated = {one["name"]: one for one in content["parameters"]}
    for name, factor, unit in (
        ("camera_from_tool.translation.x", 1e3, "mm"),
        ("camera_from_tool.rotation.z", 180.0 / np.pi, "deg"),
        ("camera.u0", 1.0, "px"),
    ):
        assert stated[name]["unit"] == unit
        assert stated[name]["std"] == pytest.approx(factor * stds[name], rel=1e-6)
    assert stated["target_scale"]["held"]
    noise = content["robot_errors"]
    assert noise["position_std_mm"] == pytest.approx(1e3 * saved.noise.translation)
    assert noise["pixel_std_px"] == pytest.approx(saved.noise.pixel)
    assert sum(noise["probabilities"].values()) == pytest.approx(1.0, abs=1e-6)


def test_the_errors_are_those_of_the_library(calibrated, folder):
    content, out = calibrated
    data = load_dataset(folder)
    errors = {one["name"]: one for one in content["errors"]}
    staged = Calibration.load(out / "calibration_staged.yaml")
    expected = reprojection_errors(staged, data)
    assert errors["staged"]["fitted"]["rms_px"] == pytest.approx(expected.rms, rel=1e-6)
    assert errors["staged"]["fitted"]["rms_mm"] == pytest.approx(expected.rms_mm, rel=1e-6)
    assert errors["joint"]["held_out"]["folds"] == 5
    low, high = errors["joint"]["held_out"]["rms_interval_95_px"]
    assert low < errors["joint"]["held_out"]["rms_px"] < high
    # Without --diagnose there is none of it.
    assert content["budget"] is content["halves"] is None
    assert errors["joint"]["held_out_by_region"] is None


def test_a_comparison_has_every_method(folder, monkeypatch):
    def refused(_):
        raise ValueError("not today")

    methods = {"staged": lambda part: fit_staged(part, "opencv4"), "other": refused}
    monkeypatch.setattr(
        sys.modules["smartview_jax.evaluation"], "standard_methods", lambda _, **__: methods
    )
    ended = run("compare", str(folder), "--json")
    assert ended.exit_code == 0, ended.output
    content = document(ended, "compare")
    staged, other = content["methods"]
    expected = compare(load_dataset(folder), methods)[0]
    assert staged["fitted"]["mean_px"] == pytest.approx(expected.fitted.mean)
    assert staged["fitted"]["std_px"] == pytest.approx(expected.fitted.std)
    assert staged["held_out"]["rms_px"] == pytest.approx(expected.held_out.errors.rms)
    assert (other["failure"], other["fitted"], other["held_out"]) == ("not today", None, None)


def test_an_evaluation_has_every_calibration_and_view(calibrated, folder, tmp_path):
    _, out = calibrated
    words = ["evaluate", str(out / "calibration.yaml"), str(folder), "--json"]
    compared = ["--compare", str(folder / "truth.yaml"), "--out", str(tmp_path / "page.html")]
    ended = run(*words, *compared)
    assert ended.exit_code == 0, ended.output
    content = document(ended, "evaluate")
    first, second = content["calibrations"]
    data = load_dataset(folder)
    errors = reprojection_errors(Calibration.load(folder / "truth.yaml"), data)
    assert second["file"] == str(folder / "truth.yaml")
    assert second["rms_px"] == pytest.approx(errors.rms)
    assert second["rms_interval_95_px"] == pytest.approx(list(rms_interval(errors)))
    assert list(second["rms_by_view_px"].values()) == pytest.approx(list(errors.rms_per_view))
    assert list(second["rms_by_view_px"]) == list(data.view_ids)
    # The truth says nothing of its uncertainty; the calibration does.
    assert second["over_expected"] is None
    assert first["over_expected"] == pytest.approx(first["rms_px"] / first["expected_rms_px"])
    assert content["page"] == str(tmp_path / "page.html")


def test_a_check_has_the_figures_and_the_problems(folder):
    ended = run("check", str(folder), "--json")
    assert ended.exit_code == 0, ended.output
    content = document(ended, "check")
    data = load_dataset(folder)
    positions = np.asarray(data.base_from_tool.translation())
    assert content["tool_extent_mm"] == pytest.approx(list(1e3 * np.ptp(positions, axis=0)))
    assert content["usable_views"] == content["views"] == VIEWS
    assert content["points_per_view"] == {"least": 15, "greatest": 15, "median": 15.0}
    rotations = data.base_from_tool.rotation()
    angles = [
        np.linalg.norm(np.asarray((rotations.inverse() @ type(rotations)(one)).log()), axis=1)
        for one in rotations.wxyz
    ]
    assert content["largest_rotation_deg"] == pytest.approx(np.rad2deg(np.max(angles)), abs=1e-4)
    assert content["can_be_calibrated"]
    assert content["problems"] == []


def test_a_data_set_that_cannot_be_calibrated_is_a_document_too(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    text = (tmp_path / "dataset.yaml").read_text()
    (tmp_path / "dataset.yaml").write_text(text.replace("base_from_tool", "tool_from_base"))
    ended = run("check", str(tmp_path), "--json")
    assert ended.exit_code == 1
    content = document(ended, "check")
    assert not content["can_be_calibrated"]
    assert "inverted" in content["problems"][0]


def test_an_error_is_no_document(tmp_path):
    for words in (["check"], ["calibrate"], ["compare"], ["evaluate", "no.yaml"]):
        ended = run(*words, str(tmp_path / "nowhere"), "--json")
        assert ended.exit_code == 2
        assert ended.stdout == ""
        assert ended.stderr.startswith("smartview: ")
