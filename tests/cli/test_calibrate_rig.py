"""`smartview calibrate A B --together`: the folders are cameras that watched one robot."""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from smartview_jax import load_estimate, save_dataset
from smartview_jax.cli import app
from smartview_jax.simulation import six_axis_rig_scene
from smartview_jax.targets import Chessboard


@pytest.fixture(scope="module")
def scene():
    return six_axis_rig_scene(1, cameras=2)


@pytest.fixture(scope="module")
def folders(scene, tmp_path_factory):
    place = tmp_path_factory.mktemp("rig")
    target = Chessboard(rows=9, columns=12, square=0.03)
    for name, data in scene.rig.cameras.items():
        save_dataset(dataclasses.replace(data, target=target), place / name)
    return [str(place / name) for name in scene.rig.cameras]


def test_a_calibration_for_each_camera(scene, folders, tmp_path):
    out = tmp_path / "out"
    told = CliRunner().invoke(
        app, ["calibrate", *folders, "--together", "--json", "--out", str(out)]
    )
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["converged"]
    assert document["states"] == 16
    for name, truth in scene.calibrations.items():
        estimate = load_estimate(out / f"{name}.yaml")
        found = np.asarray(estimate.calibration.camera_from_tool.translation())
        assert document["cameras"][name]["camera_from_tool"]["translation"] == pytest.approx(found)
        true = np.asarray(truth.camera_from_tool.translation())
        assert np.linalg.norm(found - true) < 3e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--together"], "expected folders of different names"),
        (["{0}", "{0}", "--together"], "expected folders of different names"),
        (["{0}", "{1}", "--together", "--free", "target_scale"], "--free: not with --together"),
        (["{0}", "{1}", "--together", "--diagnose"], "--diagnose: not with --together"),
    ],
)
def test_what_a_rig_cannot_have_is_refused(folders, tmp_path, arguments, message):
    texts = [text.format(*folders) for text in arguments]
    out = tmp_path / "out"
    told = CliRunner().invoke(app, ["calibrate", *texts, "--out", str(out)])
    assert told.exit_code == 2
    assert message in " ".join(told.stderr.split())
    assert not out.exists()
