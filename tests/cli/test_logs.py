"""With --verbose the library says what it does, and without it only the command speaks."""

import json
import os
import re
import subprocess
import sys

import pytest


def python(code, **variables):
    environment = {k: v for k, v in os.environ.items() if k != "OPENCV_LOG_LEVEL"}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "data"
    ended = smartview("simulate", path, "--views", "6")
    assert ended.returncode == 0, ended.stderr
    return path


def smartview(*words):
    return python(
        "from smartview_jax.cli import app; import sys; app(sys.argv[1:] or "
        f"{[str(word) for word in words]!r})"
    )


def test_importing_the_library_configures_nothing():
    ended = python(
        "import logging, smartview_jax as sv, smartview_jax.cli\n"
        "sv.fit_joint, sv.load_dataset\n"
        "own = logging.getLogger('smartview_jax')\n"
        "print(own.handlers, own.level, logging.getLogger().handlers)"
    )
    assert ended.stdout.strip() == "[] 0 []"


def test_verbose_names_the_module_and_leaves_stdout_alone(folder):
    quiet, told = (smartview(*words, "check", folder, "--json") for words in ((), ("-v",)))
    assert quiet.returncode == told.returncode == 0
    assert "smartview_jax." not in quiet.stderr
    line = r"^ *\d+ ms  smartview_jax\.io\.load: .*data: 6 views, 324 points, 0 masked$"
    assert re.search(line, told.stderr, re.MULTILINE)
    assert re.search(
        r"smartview_jax\.staged\.fit: Step 2: 0\.\d+ px RMS", told.stderr, re.MULTILINE
    )
    # The document is the same with and without.
    assert json.loads(told.stdout) == json.loads(quiet.stdout)


@pytest.mark.parametrize(("verbosity", "spoken"), [(0, False), (2, True)])
def test_other_libraries_are_kept_off_the_screen(verbosity, spoken):
    ended = python(
        "from smartview_jax.cli.logs import configure_logs\n"
        f"configure_logs({verbosity})\n"
        "import logging, cv2\n"
        "cv2.imread('nowhere.png')\n"
        "logging.getLogger('absl').warning('delicate')\n"
    )
    assert ("nowhere.png" in ended.stderr) == spoken
    assert ("delicate" in ended.stderr) == spoken


def test_what_a_person_set_for_opencv_stays():
    code = (
        "from smartview_jax.cli.logs import configure_logs\n"
        "configure_logs(0)\n"
        "import cv2; cv2.imread('nowhere.png')"
    )
    assert "nowhere.png" in python(code, OPENCV_LOG_LEVEL="WARNING").stderr


def test_a_second_call_does_not_say_everything_twice():
    ended = python(
        "from smartview_jax.cli.logs import configure_logs\n"
        "configure_logs(1); configure_logs(1)\n"
        "import logging; logging.getLogger('smartview_jax.here').info('once')"
    )
    assert ended.stderr.count("once") == 1


def test_a_program_that_calls_the_command_keeps_its_loggers():
    ended = python(
        "import logging\n"
        "from typer.testing import CliRunner\n"
        "from smartview_jax.cli import app\n"
        "levels = lambda: [logging.getLogger(n).level for n in ('smartview_jax', 'jax', 'absl')]\n"
        "before = levels()\n"
        "assert CliRunner().invoke(app, ['-v', 'schema', 'dataset']).exit_code == 0\n"
        "print(levels() == before, logging.getLogger('smartview_jax').handlers)"
    )
    assert ended.stdout.strip() == "True []", ended.stderr
