"""What is imported, and when: the command and the package start without JAX."""

import ast
import dataclasses
import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from main_job import main_job, user_environment

import smartview_jax as sv
from smartview_jax.cameras import lens_by_name
from smartview_jax.simulation import paper_calibration

PACKAGE = Path(sv.__file__).parent

SLOW = {"jax", "matplotlib", "cv2", "scipy", "jaxtyping"}
"""Packages that take a tenth of a short answer or more to import; typer may import pydantic."""

COMMANDS = {
    "--help": (0, "Calibrate cameras on robot arms"),
    "calibrate --help": (0, "calibration.yaml"),
    "--version": (0, sv.__version__),
    "calibrate --lenz weng": (2, "No such option"),
    "calibrat": (2, "No such command"),
}
"""What needs no data, with its exit code and what it says."""

START = """
import sys
slow, finders = set(sys.argv[1].split()), [*sys.meta_path]
import smartview_jax
print(slow & set(sys.modules), "finders as before:", sys.meta_path == finders)
from smartview_jax.cli import app
print("pydantic:", "pydantic" in sys.modules)
for words in sys.argv[2:]:
    print("next:", words)
    try:
        app(words.split())
    except SystemExit as ended:
        print("code", ended.code, slow & set(sys.modules))
"""


def run(code, *arguments):
    """What a process writes to stdout and stderr, in order."""
    words = [sys.executable, "-u", "-c", code, *arguments]
    return subprocess.run(
        words, text=True, env=user_environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )


def said_by(commands):
    """What each of several commands of one process says, and what the package's import does."""
    package, *said = run(START, " ".join(SLOW), *commands).stdout.split("next: ")
    assert len(said) == len(commands), (package, *said)
    return package, said


def test_the_package_and_what_needs_no_data_load_nothing_slow():
    """Nor does pydantic load before a file is read, or how Python imports change."""
    package, commands = said_by(COMMANDS)
    assert package == "set() finders as before: True\npydantic: False\n"
    for text, (words, (code, said)) in zip(commands, COMMANDS.items(), strict=True):
        assert text.startswith(f"{words}\n")
        assert said in text.partition("\n")[2]
        assert text.endswith(f"code {code} set()\n"), text


def test_every_public_name_is_listed_and_there():
    """What the stub says, which type checkers and editors read, is what is found."""
    assert {"Camera", "Dataset", "calibrate", "load_dataset", "io", "robots"} <= set(dir(sv))
    assert set(sv.__all__) <= set(dir(sv))
    for name in dir(sv):
        assert getattr(sv, name) is not None
    with pytest.raises(AttributeError, match="never"):
        _ = sv.never


FACES = {
    ".".join(stub.parent.relative_to(PACKAGE.parent).parts): ast.parse(stub.read_text()).body
    for stub in sorted(PACKAGE.rglob("__init__.pyi"))
}
"""What the stub of every package lists, by the package's name."""


@pytest.mark.parametrize("package", FACES)
def test_every_name_in_a_stub_is_there_and_no_submodule_hides_it(package):
    face = importlib.import_module(package)
    # Modules whose names are functions' names too, such as `localize`, come before the functions.
    for imported in FACES[package]:
        if imported.module:
            importlib.import_module(f"{package}.{imported.module}")
    for imported in FACES[package]:
        for alias in imported.names:
            place = f"{package}.{imported.module or alias.name}"
            module = importlib.import_module(place)
            expected = getattr(module, alias.name) if imported.module else module
            assert getattr(face, alias.name) is expected, (place, alias.name)


def test_packages_load_none_of_their_files_until_a_name_is_used():
    loaded = (
        f"import {', '.join(FACES)}, sys\n"
        "print([name for name, module in sys.modules.items() "
        "if name.startswith('smartview_jax.') and not hasattr(module, '__path__')])"
    )
    assert run(loaded).stdout == "['smartview_jax.runtime.double_precision']\n"


def test_the_package_and_its_rooms_show_the_same_objects():
    assert sv.Camera is importlib.import_module("smartview_jax.cameras").Camera
    assert sv.cameras is importlib.import_module("smartview_jax.cameras")
    assert sv.held_out is importlib.import_module("smartview_jax.evaluation").held_out


def test_importing_configures_no_logger():
    """That is for the program to do."""
    done = run(
        "import logging, smartview_jax.joint\n"
        'own = logging.getLogger("smartview_jax")\n'
        "assert (own.handlers, own.level, logging.getLogger().handlers) == ([], 0, [])"
    )
    assert done.returncode == 0, done.stdout


def test_a_default_calibration_has_few_programs_to_compile(tmp_path_factory):
    """A count, not a time: every program costs a newcomer a part of the first answer's seconds.

    Programs that other tests compiled are read, which counts as building them, too. The folds have
    fewer views than the whole, and are padded to the same size: each is fitted by the same
    programs.
    """
    programs = main_job(tmp_path_factory).programs
    assert programs["loading"] == 0, "reading the data compiles nothing"
    assert 10 < programs["all"] <= 22, programs


def test_a_calibration_is_exported_without_anything_slow(tmp_path):
    """A line of numbers must not cost the seconds that JAX takes to import."""
    path = tmp_path / "calibration.yaml"
    calibration = paper_calibration()
    lens = lens_by_name("opencv5")
    camera = dataclasses.replace(calibration.camera, lens=lens)
    dataclasses.replace(calibration, camera=camera).save(path)
    forms = "ros", "ros_launch", "urdf", "camera_info", "opencv"
    for text in said_by([f"export {path} --to {form}" for form in forms])[1]:
        assert text.endswith("code 0 set()\n"), text


def test_an_export_loads_no_other_subcommand(tmp_path):
    path = tmp_path / "calibration.yaml"
    paper_calibration().save(path)
    others = "smartview_jax.cli.calibrate smartview_jax.cli.viewpoint smartview_jax.cli.grasp"
    said = run(START, others, f"export {path} --to ros").stdout
    assert said.endswith("code 0 set()\n"), said


PROGRAMS = """
from smartview_jax.runtime.program_store.store import _stores
print(sorted(store._function.__name__ for store in _stores for _ in store._programs))
"""


ROBOT_COMMANDS = {
    "viewpoint": "",
    "stylus": "--tip 0,0.01,0.15 --allow behind-target",
    "grasp": "--grasp-pose 0,0,0.01,0,180,0 --allow behind-target",
}
"""The subcommands that only compute commands, with what they need to know."""


@pytest.mark.parametrize("verb", ROBOT_COMMANDS)
def test_robot_commands_load_no_fits_and_few_programs(tmp_path_factory, verb):
    """They take a second less: the fits and their libraries are half of the imports.

    One program has the commands and the poses expected of them, one the checks, and two the error
    of the camera. Each takes a tenth of a second to read.
    """
    path = main_job(tmp_path_factory).out / "calibration.yaml"
    fits = "optimistix lineax scipy cv2 matplotlib smartview_jax.staged smartview_jax.variance"
    said = run(
        START + PROGRAMS,
        f"{fits} smartview_jax.cli.calibrate",
        f"{verb} {path} {ROBOT_COMMANDS[verb]}",
    ).stdout
    assert {"viewpoint": "of the camera", "stylus": "ellipse", "grasp": "of the tool"}[verb] in said
    *_, ended, programs = said.splitlines()
    assert ended == "code 0 set()", said
    assert programs == str(
        ["_commands_with_checks", "_expected_command", "_relevance", "_view_jacobians"]
    )
