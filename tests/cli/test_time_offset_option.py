"""A robot that logged its poses in motion: the command finds how its clock differs."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from jaxlie import SE3
from moving_camera import circling_commands
from typer.testing import CliRunner

import smartview_jax as sv
from smartview_jax.cli import app
from smartview_jax.geometry import host_matrices
from smartview_jax.io.csv_tables import read_table, write_table
from smartview_jax.simulation import paper_calibration, simulate
from smartview_jax.targets import Chessboard

BOARD, OFFSET = Chessboard(7, 5, 0.005), 0.06
LOG_TIMES = np.arange(0.0, 15.0, 0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path, rng = tmp_path_factory.mktemp("logged"), np.random.default_rng(0)
    times = np.sort(rng.uniform(1.0, 14.0, 10))
    errors = rng.normal(size=(10, 6)) * np.repeat([5e-5, 1e-4], 3)
    actual = circling_commands(times, BOARD.points) @ SE3.exp(jnp.asarray(errors))
    data = simulate(paper_calibration(), actual, BOARD.points, pixel_noise=0.15).data
    sv.save_dataset(dataclasses.replace(data, target=BOARD), path)
    rows = host_matrices(circling_commands(LOG_TIMES, BOARD.points)).reshape(-1, 16)
    _, *columns = read_table(path / "poses.csv", ())[0]
    write_table(
        path / "poses.csv",
        ["time", *columns],
        [(time, *row) for time, row in zip(LOG_TIMES, rows, strict=True)],
    )
    write_table(
        path / "times.csv",
        ["view", "time"],
        [(view, time - OFFSET) for view, time in zip(data.view_ids, times, strict=True)],
    )
    content = yaml.safe_load((path / "dataset.yaml").read_text())
    content["poses"] |= {"picture_times": "times.csv", "rows": len(LOG_TIMES)}
    (path / "dataset.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def test_the_offset_is_estimated_and_said(folder, tmp_path):
    words = ["calibrate", folder, "--time-offset", "--no-held-out", "--out", tmp_path]
    ended = CliRunner().invoke(app, [*map(str, words)])
    assert ended.exit_code == 0, ended.output
    text = " ".join(ended.output.split())
    _, _, said = text.partition("robot's clock minus camera's: ")
    milliseconds, half_width = (float(word) for word in said.split()[:3:2])
    assert abs(milliseconds - 1e3 * OFFSET) < 1.6 * half_width
    assert "(in dataset.yaml: poses.time_offset: 0.0" in text
    assert "robot&#39;s clock minus camera&#39;s" in (tmp_path / "report.html").read_text()


def test_without_a_log_there_is_nothing_to_estimate():
    ended = CliRunner().invoke(app, ["calibrate", "--time-offset"])
    assert ended.exit_code == 2
    assert "this one has a pose for each view" in " ".join(ended.output.split())
