"""A robot that logged its poses in motion: the command finds how its clock differs."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from board_scene import BOARD, LENS, VIEWS, board_folder, run
from jaxlie import SE3
from moving_camera import circling_commands

import smartview_jax as sv
from smartview_jax.clocks import TimeOffset, at_time_offset
from smartview_jax.engine import Noise
from smartview_jax.geometry import host_matrices
from smartview_jax.io.csv_tables import read_table, write_table
from smartview_jax.simulation import paper_calibration, simulate

OFFSET = 0.06
TIMES = np.sort(np.random.default_rng(1).uniform(1.0, 14.0, VIEWS))
LOG_TIMES = np.arange(0.0, 15.0, 0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path, rng, times = tmp_path_factory.mktemp("logged"), np.random.default_rng(0), TIMES
    errors = rng.normal(size=(VIEWS, 6)) * np.repeat([5e-5, 1e-4], 3)
    actual = circling_commands(times, BOARD.points) @ SE3.exp(jnp.asarray(errors))
    data = simulate(paper_calibration(), actual, BOARD.points, pixel_noise=0.15).data
    sv.save_dataset(dataclasses.replace(data, target=BOARD), path)
    rows = host_matrices(circling_commands(LOG_TIMES, BOARD.points)).reshape(-1, 16)
    _, *columns = read_table(path / "poses.csv", ()).rows[0]
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


def test_the_offset_is_estimated_and_said(folder, tmp_path, monkeypatch):
    """The estimate itself, which takes many fits, has tests of its own: here it is known."""
    asked = []

    def known(data, trajectory, picture_times, lens, progress):
        asked.append((trajectory.times, picture_times, lens))
        corrected = at_time_offset(data, trajectory, picture_times, OFFSET)
        return TimeOffset(OFFSET, 1e-3, corrected, Noise(0.15, 1e-4, 1e-4))

    monkeypatch.setattr("smartview_jax.estimate_time_offset", known)
    ended = run("calibrate", folder, *LENS, "--time-offset", "--no-held-out", "--out", tmp_path)
    assert ended.exit_code == 0, ended.output
    ((log_times, picture_times, lens),) = asked
    np.testing.assert_allclose(log_times, LOG_TIMES, atol=1e-12)
    np.testing.assert_allclose(picture_times, TIMES - OFFSET, atol=1e-12)
    assert lens == "radial"
    text = " ".join(ended.output.split())
    assert "robot's clock minus camera's: 60.00 +- 1.96 ms" in text
    assert "(in dataset.yaml: poses.time_offset: 0.060000" in text
    assert "robot&#39;s clock minus camera&#39;s" in (tmp_path / "report.html").read_text()
    # With poses of another time the transform would be off by as much as the robot went.
    found = sv.Calibration.load(tmp_path / "calibration.yaml").camera_from_tool
    off = (found.inverse() @ paper_calibration().camera_from_tool).translation()
    assert np.linalg.norm(off) < 3e-3


def test_without_a_log_there_is_nothing_to_estimate(tmp_path_factory, monkeypatch):
    """Neither in a folder with a pose for each view nor in the sample, which has no folder."""
    board = board_folder(tmp_path_factory)
    data = sv.load_dataset(board)
    # The sample's circles need not be looked for.
    monkeypatch.setattr(
        "smartview_jax.cli.calibrate_folder.load_named", lambda *_, **__: (data, "data")
    )
    for named in ((board,), ()):
        ended = run("calibrate", *named, "--time-offset")
        assert ended.exit_code == 2
        assert "this one has a pose for each view" in " ".join(ended.output.split())
