"""`smartview model`, from the command line to the page."""

import shutil
import signal
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from board_scene import calibrated_board, run

from smartview_jax.cli.load import RigOptions, load_views
from smartview_jax.cli.model import load_calibration
from smartview_jax.editor.owner_lock import OwnerLock
from smartview_jax.io import object_sample_folder
from smartview_jax.joint import load_estimate
from smartview_jax.simulation import paper_calibration

pytest.importorskip("uvicorn")


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(object_sample_folder(), tmp_path / "sample")
    return tmp_path / "sample"


def test_the_sample_is_opened_and_ends_by_ctrl_c(folder):
    paper_calibration().save(folder / "calibration.yaml")
    code = "from smartview_jax.cli import app; app()"
    words = ["model", str(folder), "--out", str(folder / "block.json"), "--no-browser"]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert "block.json" in process.stdout.readline()
        address = process.stdout.readline().strip()
        with urllib.request.urlopen(address) as page:
            assert b"smartview" in page.read()
        busy = run(*words)
        assert busy.exit_code == 2
        assert f"open in another editor: process {process.pid}" in busy.output
        process.send_signal(signal.SIGINT)
        process.wait(timeout=20)
    finally:
        process.kill()
        _, said = process.communicate()
    assert "Traceback" not in said
    # A process that was too busy to end by itself leaves a lock, which no longer holds.
    OwnerLock(folder / "block.json.lock").release()
    assert (folder / "block.json.journal").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "nowhere"),
        (["{folder}"], "calibration.yaml: no such file; give a calibration by --calibration"),
        (["{folder}", "--calibration", "{folder}/truth.json"], "truth.json"),
    ],
)
def test_what_is_missing_is_named(folder, words, said):
    done = run("model", *(word.format(folder=folder) for word in words))
    assert done.exit_code == 2
    assert said in done.output
    assert not (folder / "object.json.lock").exists()


def test_a_data_set_of_a_board_is_a_data_set_of_views(folder):
    from smartview_jax.io import load_view_pictures

    loaded = load_view_pictures(folder)
    assert len(loaded.view_ids) == len(loaded.pictures) == 12
    assert all(path.is_file() for path in loaded.pictures)
    np.testing.assert_allclose(np.linalg.det(loaded.base_from_tool[:, :3, :3]), 1.0)


def test_a_calibration_comes_with_its_covariance_where_the_file_has_one(
    folder, tmp_path_factory, capsys
):
    fitted = calibrated_board(tmp_path_factory).calibration
    shutil.copy(fitted, folder / "calibration.yaml")
    views = load_views(folder)
    calibration, estimate = load_calibration(folder, None, views, RigOptions())
    assert estimate is not None
    known = load_estimate(fitted)
    assert estimate.parameter_names == known.parameter_names
    np.testing.assert_array_equal(estimate.covariance, known.covariance)
    assert float(calibration.camera.alpha_u) == float(known.calibration.camera.alpha_u)
    calibration.save(folder / "calibration.yaml")
    assert load_calibration(folder, None, views, RigOptions())[1] is None
    assert "taken as exact" in capsys.readouterr().err
