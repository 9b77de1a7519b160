"""A data set that was simulated is what its truth says, within the noise that was asked for."""

import numpy as np
import pytest
from typer.testing import CliRunner

from smartview_jax import Calibration, load_dataset
from smartview_jax.cli import app
from smartview_jax.evaluation import reprojection_errors


def simulated(folder, *options):
    return CliRunner().invoke(app, ["simulate", str(folder), "--views", "5", *options])


def test_the_truth_predicts_what_was_written(tmp_path):
    noise = ("--pixel-noise", "0.2", "--position-noise", "0", "--angle-noise", "0")
    run = simulated(tmp_path / "data", *noise)
    assert run.exit_code == 0, run.output
    data = load_dataset(tmp_path / "data")
    truth = Calibration.load(tmp_path / "data" / "truth.yaml")
    # u and v have 0.2 px each.
    errors = reprojection_errors(truth, data)
    assert errors.rms == pytest.approx(0.2 * np.sqrt(2.0), rel=0.1)
    assert data.view_count == 5


def test_poses_err_by_what_was_asked_for(tmp_path):
    simulated(tmp_path / "exact", "--position-noise", "0", "--angle-noise", "0")
    simulated(tmp_path / "noisy", "--position-noise", "1", "--angle-noise", "0")
    exact, noisy = (load_dataset(tmp_path / name).base_from_tool for name in ("exact", "noisy"))
    difference = np.asarray(exact.translation() - noisy.translation())
    assert 0.4e-3 < difference.std() < 1.8e-3


def test_pictures_show_the_target_where_the_truth_says(tmp_path):
    noise = ("--position-noise", "0", "--angle-noise", "0")
    run = simulated(tmp_path / "data", "--pictures", *noise)
    assert run.exit_code == 0, run.output
    data = load_dataset(tmp_path / "data")
    truth = Calibration.load(tmp_path / "data" / "truth.yaml")
    assert np.asarray(data.visible).all()
    assert reprojection_errors(truth, data).rms < 0.1


def test_nothing_is_overwritten(tmp_path):
    simulated(tmp_path / "data")
    again = simulated(tmp_path / "data")
    assert again.exit_code == 2
    assert "exists already" in again.output
    assert simulated(tmp_path / "other", "--pixel-noise", "-1").exit_code == 2
