"""The words of `smartview capture`, its refusals, and a whole run without a person."""

import json
import sys

import numpy as np
import pytest
from board_scene import run
from capture_scene import Rig, RigCamera, RigRobot, everywhere, new_folder, quick_fit

from smartview_jax import Calibration
from smartview_jax.io import load_dataset
from smartview_jax.simulation import paper_calibration

REFUSED = {
    "": "expected the folder of a data set",
    "nowhere": "nowhere/dataset.yaml: no such file; smartview new begins",
    "{data} --camera nothing": "--camera: expected an index such as 0",
    "{data} --camera {data}/images": "is where the views are stored",
    "{data} --camera simulated": "--camera and --robot: expected both simulated",
    "{data} --robot tcp:here": "--robot: expected tcp:HOST:PORT",
    "{data} --robot tcp:here:70000": "--robot: expected tcp:HOST:PORT",
    "{data} --format ouija": "ouija",
    "{data} --robot tcp:127.0.0.1:5000 --move": "--move: needs --box x,y,z,x,y,z",
    "{data} --robot tcp:127.0.0.1:5000 --box 0,0,0,1,1,1": "--box: only with --move",
    "{data} --robot tcp:127.0.0.1:5000 --move --box 1,2": "--box: expected 6 numbers",
    "{data} --auto": "--auto: needs a robot that reports its poses, found typed",
    "{data} --robot tcp:127.0.0.1:5000 --auto --move --box 0,0,0,1,1,1": "needs --start",
    "{data} --start ouija=1,2,3,4,5,6": "--start: expected camera_from_tool",
    "{data} --robot ur:127.0.0.1": "pip install 'smartview-jax[ur]'",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_is_wrong_is_said_before_anything_moves(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    folder = new_folder(tmp_path / "data")
    ended = run("capture", *words.format(data=folder).split())
    assert ended.exit_code == 2, ended.output
    assert REFUSED[words] in ended.stderr.replace("\n", " ")
    assert "Traceback" not in ended.output


@pytest.mark.parametrize("name", ["krl", "rapid", "urscript", "val3", "ros2"])
def test_a_program_for_a_controller_is_printed(name):
    ended = run("capture", "--print-program", name)
    assert ended.exit_code == 0
    assert "smartview capture FOLDER --robot" in ended.stdout


class RigCell:
    """The rig in place of the simulated cell, whose pictures take a second each."""

    def __init__(self, rig):
        self.camera = lambda: rig.opened_source("camera", RigCamera)
        self.robot = lambda: rig.opened_source("robot", RigRobot)
        self.limits = everywhere()

    def write_description(self, folder):
        new_folder(folder)

    @property
    def drawing(self):
        """The camera turned by 90 degrees on the hand, to a centimetre, and the board face down."""
        camera_from_tool, base_from_world = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0])
        camera_from_tool[:3] = [[0, -1, 0, 0.03], [1, 0, 0, 0.08], [0, 0, 1, -0.06]]
        base_from_world[:3, 3] = 0.72, 0.0, 0.02
        camera = paper_calibration().camera
        return Calibration.eye_in_hand(camera, camera_from_tool, base_from_world)


def test_a_run_without_a_person(tmp_path, monkeypatch):
    rig = Rig()
    monkeypatch.setattr("smartview_jax.capture.session.estimate", quick_fit(rig))
    monkeypatch.setattr("smartview_jax.capture.SimulatedSources", lambda seed: RigCell(rig))
    folder = tmp_path / "data"
    words = f"{folder} --camera simulated --robot simulated --move --auto --json --goal 1 --above"
    ended = run("capture", *words.split())
    document = json.loads(ended.stdout)
    assert ended.exit_code == (0 if document["reached"] else 1)
    assert document["goal_mm"] == 1.0
    data = load_dataset(folder)
    assert data.view_count == document["views"] >= 4
    # The last views may be in no fit yet: the stated error is the last fit's.
    assert 9.0 / document["views"] - 1e-9 <= document["std_mm"] <= 1.0
    assert "view v1 taken" in ended.stderr
    assert np.isfinite(np.asarray(data.pixels)).any()
