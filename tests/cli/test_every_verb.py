"""Every verb says what it did and ends with 0, and says what is wrong and ends with its code."""

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import typer
from board_scene import board_folder, run
from text_files import unwrapped

from smartview_jax import fit_staged
from smartview_jax.cli import app
from smartview_jax.io import object_sample_folder, save_object_model
from smartview_jax.localization import Localization, Localizations
from smartview_jax.modeling import ObjectModel
from smartview_jax.simulation import CellError

TIP = "--tip 0,0,0.1 --above"
FRAMES = "--base base --tool tool0"
GRASP = "--grasp-pose 0,0,0.01,0,180,0"
VIEWS = "object/calibration.yaml object"
ROUGH = "--start camera_from_tool=0,0.05,0.06,0,0,0 --start base_from_world=0.5,0.1,0,0,0,180"


class Case(NamedTuple):
    """Words after the verb, the exit code, and what is said: on stdout if it went well."""

    verb: str
    words: str
    code: int
    said: str


CASES = (
    Case(
        "calibrate",
        "data --lens radial --no-held-out --out result",
        0,
        "result/calibration.yaml: the",
    ),
    Case("calibrate", "nowhere", 2, "nowhere: no such folder"),
    Case("calibrate", "data --lens glass", 2, "lens is one of"),
    Case("calibrate", "data/dataset.yaml", 2, "describes a data set: give its folder"),
    Case("capture", "live --camera simulated --robot simulated --no-browser", 0, "live is at http"),
    Case("capture", "--print-program rapid", 0, "MODULE SmartviewCapture"),
    Case("capture", "nowhere", 2, "nowhere/dataset.yaml"),
    Case("check", "data", 0, "camera and robot agree: ready for smartview calibrate"),
    Case("check", "inverted", 1, "problem: "),
    Case("check", "nowhere", 2, "nowhere: no such folder"),
    Case("check", "data/poses.csv", 2, "poses.csv: is a file, expected the folder"),
    Case("compare", "data --lens radial", 0, "on views that no fit saw"),
    Case("compare", "nowhere", 2, "nowhere: no such folder"),
    Case("demo", "--out demo", 0, "in the hand after the lift: yes"),
    Case("demo", "--out demo --seed 13", 1, "in the hand after the lift: no demo/page: the"),
    Case("demo", "--out demo --seed 14", 2, "--seed 14: the cell failed: objects are still moving"),
    Case("demo", "--views 3", 2, "--views: expected 8 or more, found 3"),
    Case("evaluate", "data/truth.yaml data", 0, "truth predicts the target in data to"),
    Case("evaluate", "nowhere.yaml data", 2, "nowhere.yaml"),
    Case("evaluate", "data data/truth.yaml", 2, "data: is a folder, expected a file"),
    Case(
        "evaluate",
        "data/dataset.yaml data",
        2,
        "dataset.yaml: a file of the kind smartview_calibration is expected, found "
        "smartview_dataset",
    ),
    Case("export", "data/truth.yaml --to urdf", 0, "<origin xyz="),
    Case("export", "data/truth.yaml --to robot_urdf --arm puma_560", 0, '<link name="tool0"/>'),
    Case("export", "data/truth.yaml --to robot_urdf", 2, "the calibration knows no arm"),
    Case("export", "data/truth.yaml --to ros --arm puma_560", 2, "only with --to robot_urdf"),
    Case("export", "data/truth.yaml --to ouija", 2, "'ouija' is not one of"),
    Case("export", "data/dataset.yaml --to urdf", 2, "data/dataset.yaml"),
    Case("grasp", f"data/truth.yaml {GRASP}", 0, "approach"),
    Case("grasp", "data/truth.yaml", 2, "give either --grasp-pose or --model"),
    Case("import", f"run.bag mine {FRAMES} --target charuco", 0, "mine: 2 views; next steps:"),
    Case("import", f"nowhere.bag mine {FRAMES} --target charuco", 2, "nowhere.bag: no such bag"),
    Case("import", f"run.bag mine {FRAMES}", 2, "--target: expected the target in the pictures"),
    Case("localize", f"{VIEWS} object/block.json", 0, "Found for certain in 0 pictures: block."),
    Case("localize", f"{VIEWS} object/absent.json", 1, "Nothing was found for certain."),
    Case("localize", f"{VIEWS} nowhere.json", 2, "nowhere.json"),
    Case("model", "object --no-browser", 0, "the editor of object/object.json is at"),
    Case("model", "data --no-browser", 2, "entry 'pictures' is missing"),
    Case("new", "mine --robot ur", 0, "smartview check mine"),
    Case("new", "mine --robot ouija", 2, "robot is one of abb"),
    Case("plan", f"data --below --views 3 {ROUGH}", 0, "three views will determine a point"),
    Case("plan", "data", 2, "expected calibration.yaml and its data-set folder"),
    Case("schema", "dataset", 0, '"$schema"'),
    Case("schema", "ouija", 2, "'ouija' is not one of"),
    Case("simulate", "other --views 4", 0, "other: 4 views; other/truth.yaml: the truth"),
    Case("simulate", "data", 2, "data/dataset.yaml: exists already"),
    Case("stylus", f"data/truth.yaml {TIP}", 0, "its 95 % ellipse mm"),
    Case("stylus", "data/truth.yaml", 2, "--tip"),
    Case("viewpoint", "data/truth.yaml --above", 0, "x mm"),
    Case("viewpoint", "data/truth.yaml --above --distance -1", 2, "--distance is in metres"),
)


def verbs():
    return set(typer.main.get_command(app).commands)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set, the same with inverted poses, and pictures of an object."""
    path = tmp_path_factory.mktemp("verbs")
    shutil.copytree(board_folder(tmp_path_factory), path / "data")
    shutil.copytree(path / "data", path / "inverted")
    description = path / "inverted" / "dataset.yaml"
    description.write_text(description.read_text().replace("base_from_tool", "tool_from_base"))
    shutil.copytree(object_sample_folder(), path / "object")
    shutil.copy(path / "data" / "truth.yaml", path / "object" / "calibration.yaml")
    for name in ("block", "absent"):
        model = ObjectModel(np.eye(3), np.array([[0, 1], [1, 2]]), name=name)
        save_object_model(model, path / "object" / f"{name}.json")
    if find_spec("rosbags") is not None:
        from bag_recordings import recording, stop_poses
        from written_bags import write_bag

        write_bag(path / "run.bag", "ros1", recording(stop_poses(2)))
    return path


@pytest.fixture
def short_work(monkeypatch):
    """What takes minutes or waits for a person has tests of its own: here it answers at once."""

    def run_demo(out, seed, *_):
        if seed == 14:
            raise CellError("objects are still moving")
        pick = SimpleNamespace(outcome="grasped")
        error = 1e-3 if seed != 13 else float("nan")
        return SimpleNamespace(pick=pick, held=seed != 13, position_error=error, page=out / "page")

    def localize(pictures, command, calibration, models, **_):
        evidence = SimpleNamespace(explained=0.9, edge_rms=0.2)
        verdict = SimpleNamespace(decision="accepted", evidence=evidence)
        refined = SimpleNamespace(world_from_object=np.eye(4), covariance=np.eye(6))
        found = [Localization(models[0], 0, refined, verdict, ())]
        return Localizations(found[: models[0].name == "block"], (), (), command)

    monkeypatch.setattr("smartview_jax.localize", localize)
    evaluation = sys.modules["smartview_jax.evaluation"]
    methods = {"staged": lambda part: fit_staged(part, "radial")}
    monkeypatch.setattr(evaluation, "standard_methods", lambda *_, **__: methods)
    monkeypatch.setattr("smartview_jax.picking.run_demo", run_demo)
    monkeypatch.setattr(
        "smartview_jax.editor.serve", lambda _, __, announce: announce("http://127.0.0.1:1")
    )
    monkeypatch.setattr(
        "smartview_jax.capture.serve_capture",
        lambda _, __, announce, ___: announce("http://127.0.0.1:1"),
    )


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.verb}-{case.code}")
def test_words_and_exit_code(folder, short_work, tmp_path, monkeypatch, case):
    for part in ("data", "inverted", "object"):
        # A copy for each case: some verbs write next to their input.
        shutil.copytree(folder / part, tmp_path / part)
    if case.words.startswith("run.bag"):
        pytest.importorskip("rosbags", reason="rosbags is not installed")
        shutil.copy(folder / "run.bag", tmp_path)
    monkeypatch.chdir(tmp_path)
    ended = run(case.verb, *case.words.split())
    assert ended.exit_code == case.code, ended.output
    # Only what a user has to correct is said on stderr; an answer of "no" is an answer.
    said = ended.stderr if case.code == 2 else ended.stdout
    assert case.said in unwrapped(said)
    assert "Traceback" not in ended.output
    assert (Path("mine").exists()) == (case.verb in ("new", "import") and case.code == 0)


def test_no_verb_is_without_a_good_and_a_bad_case():
    for verb in verbs():
        codes = {case.code for case in CASES if case.verb == verb}
        assert {0, 2} <= codes, verb
    assert {case.verb for case in CASES} == verbs()


def test_help_names_every_verb():
    ended = run("--help")
    assert ended.exit_code == 0
    for verb in verbs():
        assert f" {verb} " in ended.stdout
