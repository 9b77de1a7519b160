"""A data set that was simulated is what its truth says, within the noise that was asked for."""

import functools

import numpy as np
import pytest
from typer.testing import CliRunner

from smartview_jax import Calibration, load_dataset
from smartview_jax.cli import app
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.io import read_viewpoints
from smartview_jax.simulation import write_pictures


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


def test_pictures_show_the_target_where_the_truth_says(tmp_path, monkeypatch):
    """With four rays a pixel instead of sixteen."""
    coarse = functools.partial(write_pictures, samples=2)
    monkeypatch.setattr("smartview_jax.simulation.write_pictures", coarse)
    noise = ("--position-noise", "0", "--angle-noise", "0")
    run = simulated(tmp_path / "data", "--pictures", "--views", "3", *noise)
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


def test_poses_are_written_as_the_robots_maker_does(tmp_path):
    assert simulated(tmp_path / "kuka", "--format", "kuka_abc").exit_code == 0
    assert simulated(tmp_path / "plain").exit_code == 0
    header = (tmp_path / "kuka" / "poses.csv").read_text().splitlines()[0]
    assert header == "view,x,y,z,A,B,C"
    kuka, plain = (load_dataset(tmp_path / name).base_from_tool for name in ("kuka", "plain"))
    np.testing.assert_allclose(kuka.as_matrix(), plain.as_matrix(), atol=1e-9)
    wrong = simulated(tmp_path / "wrong", "--format", "kuka")
    assert wrong.exit_code == 2
    assert "pose format is one of matrix" in wrong.stderr
    assert not (tmp_path / "wrong").exists()


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_viewpoints_that_were_commanded_are_the_poses_of_the_pictures(tmp_path, ending):
    """The way of a person: commands from one calibration, a data set from their file."""
    simulated(tmp_path / "data")
    views = tmp_path / "data" / f"views.{ending}"
    words = ["viewpoint", str(tmp_path / "data" / "truth.yaml"), "--five", "--tilt", "9.5"]
    run = CliRunner().invoke(app, [*words, "--below", "--out", str(views)])
    assert run.exit_code == 0, run.output
    text = (tmp_path / "data" / "dataset.yaml").read_text()
    begin, end = text.index("poses:"), text.index("detections:")
    entry = f"poses: {{file: {views.name}}}\n"
    (tmp_path / "data" / "dataset.yaml").write_text(text[:begin] + entry + text[end:])
    detections = tmp_path / "data" / "detections.csv"
    rows = [line.split(",", 1) for line in detections.read_text().splitlines()]
    renamed = [
        f"v{int(row[0]) + 1},{row[1]}" if row[0].isdigit() else ",".join(row) for row in rows
    ]
    detections.write_text("\n".join(renamed) + "\n")
    data = load_dataset(tmp_path / "data")
    assert data.view_ids == ("v1", "v2", "v3", "v4", "v5")
    np.testing.assert_allclose(
        data.base_from_tool.as_matrix(), read_viewpoints(views).base_from_tool.as_matrix()
    )
