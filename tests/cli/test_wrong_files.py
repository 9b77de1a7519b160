"""A file or folder of another kind than expected: one line names it, and what to give instead."""

import pytest
from board_scene import run

from smartview_jax.cli import main
from smartview_jax.simulation import paper_calibration

TIP = "--tip 0,0,0.1"

CALIBRATION = "expected a calibration, such as calibration.yaml of smartview calibrate"

GRASP = "--grasp-pose 0,0,0.01,0,180,0"

CASES = {
    # Of every verb that takes a calibration the same words.
    "viewpoint cell": "cell: is a folder, expected a file with a calibration: it has a data set; "
    "smartview calibrate cell --out RESULTS writes the file",
    "viewpoint results": "results: is a folder, expected a file with a calibration: give "
    "results/calibration.yaml",
    "viewpoint both": "both: is a folder, expected a file with a calibration: give one of "
    "left.yaml, right.yaml in it",
    "viewpoint nothing": "nothing: is a folder, expected a file with a calibration",
    "viewpoint notes.txt": f"notes.txt: expected a mapping, found str; {CALIBRATION}",
    f"grasp empty.yaml {GRASP}": f"empty.yaml: the file is empty; {CALIBRATION}",
    f"stylus other.json {TIP}": f"other.json: entry 'smartview_calibration' is missing; "
    f"{CALIBRATION}",
    "export notes.txt --to ros": f"notes.txt: expected a mapping, found str; {CALIBRATION}",
    "export cell/dataset.yaml --to ros": "cell/dataset.yaml: a file of the kind "
    "smartview_calibration is expected, found smartview_dataset",
    f"grasp results/calibration.yaml --model notes.txt {TIP.replace('--tip', '--gripper')},0,0,0": (
        "notes.txt: not readable as JSON: line 1, column 1: Expecting value; expected an object "
        "model, such as smartview model writes"
    ),
    # A folder of several cameras where one is expected.
    "plan cell": "cell has several cameras: expected the folder RESULTS that smartview calibrate "
    "cell --out RESULTS writes, with rig.joint.yaml, and this folder",
    "model cell --no-browser": "cell/dataset.yaml: cameras: expected a folder with one camera, "
    "found several; object_views.yaml describes pictures of an object by several cameras",
    "capture cell --camera nothing --robot typed": "cell/dataset.yaml: cameras: expected a folder "
    "with one camera, found several",
    # The first argument is looked at before the options.
    "import nowhere.bag mine": "nowhere.bag: no such bag",
    "import notes.txt mine": "notes.txt: expected a file .bag, .db3, .mcap, or the folder of a bag "
    "of ROS 2, or the folder of a data set of LeRobot, with meta/info.json",
    "calibrate notes.txt": "notes.txt: expected a mapping, found str; expected the folder of a "
    "data set, or a file of easy_handeye2's samples",
    "plan nowhere": "nowhere: no such file or folder",
    "plan notes.txt": "expected calibration.yaml and its data-set folder, or with --start the "
    "folder alone; found notes.txt",
    "plan results/calibration.yaml notes.txt": "notes.txt: is a file, expected the folder of a "
    "data set",
    "model notes.txt --no-browser": "notes.txt: is a file, expected the folder of a data set",
    "model nowhere --no-browser": "nowhere/dataset.yaml: no such file; smartview new "
    "begins a data set",
    # A file in the place of a new folder.
    "new notes.txt --robot ur": "notes.txt: is a file, expected a folder",
    "simulate notes.txt": "notes.txt: is a file, expected a folder",
}
"""The words, and the beginning of the line that is said."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A rig's data set, results of one camera and of two, and files of other kinds."""
    path = tmp_path_factory.mktemp("wrong")
    assert run("new", path / "cell", "--robot", "ur", "--cameras", "left,right").exit_code == 0
    for name in ("nothing", "results", "both"):
        (path / name).mkdir()
    paper_calibration().save(path / "results" / "calibration.yaml")
    for name in ("left", "right"):
        paper_calibration().save(path / "both" / f"{name}.yaml")
    (path / "both" / "rig.joint.yaml").write_text("smartview_rig: 1\n")
    (path / "notes.txt").write_text("hello\n")
    (path / "empty.yaml").write_text("")
    (path / "other.json").write_text('{"a": 1}')
    return path


@pytest.mark.parametrize("words", CASES)
def test_one_line_says_what_was_given_and_what_is_expected(folder, monkeypatch, words):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    ended = run(*words.split())
    assert ended.exit_code == 2, ended.output
    assert ended.stdout == ""
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f"smartview: {CASES[words]}")
    assert sorted(folder.rglob("*")) == before


def test_an_error_while_a_subcommand_is_imported_is_no_wrong_word(monkeypatch):
    def fail(name, package):
        raise KeyError(name)

    monkeypatch.setattr(main, "import_module", fail)
    monkeypatch.setattr(main, "SUBCOMMANDS", {**main.SUBCOMMANDS, "broken": "broken"})
    ended = run("broken")
    assert isinstance(ended.exception, KeyError), ended.output
    assert "No such command" not in ended.output
    assert run("brokn").exit_code == 2
