"""With --verbose the library says what it does, and without it only the command speaks."""

import json
import logging
import re
import subprocess
import sys

from board_scene import board_folder, run
from main_job import user_environment


def python(code, **variables):
    environment = {k: v for k, v in user_environment().items() if k != "OPENCV_LOG_LEVEL"}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_verbose_names_the_module_and_leaves_stdout_alone(tmp_path_factory):
    folder = board_folder(tmp_path_factory)
    quiet, told = (run(*words, "check", folder, "--json") for words in ((), ("-v",)))
    assert quiet.exit_code == told.exit_code == 0, told.output
    assert "smartview_jax." not in quiet.stderr
    line = r"^ *\d+ ms  smartview_jax\.io\.load: .*board: 8 views, 120 points, 0 masked$"
    assert re.search(line, told.stderr, re.MULTILINE)
    assert re.search(
        r"smartview_jax\.staged\.fit: Step 2: 0\.\d+ px RMS", told.stderr, re.MULTILINE
    )
    # The document is the same with and without.
    assert json.loads(told.stdout) == json.loads(quiet.stdout)


OTHERS = """
from smartview_jax.cli.logs import configure_logs
configure_logs({verbosity})
import logging, cv2
cv2.imread('nowhere.png')
logging.getLogger('absl').warning('delicate')
"""


def test_other_libraries_are_kept_off_the_screen():
    """And a second call does not say everything twice."""
    twice = "configure_logs(1); logging.getLogger('smartview_jax.here').info('once')"
    ended = python(OTHERS.format(verbosity=0) + twice)
    assert "nowhere.png" not in ended.stderr
    assert "delicate" not in ended.stderr
    assert ended.stderr.count("once") == 1


def test_with_more_verbosity_other_libraries_are_heard():
    ended = python(OTHERS.format(verbosity=2))
    assert "nowhere.png" in ended.stderr
    assert "delicate" in ended.stderr


def test_what_a_person_set_for_opencv_stays():
    ended = python(OTHERS.format(verbosity=0), OPENCV_LOG_LEVEL="WARNING")
    assert "nowhere.png" in ended.stderr


def test_a_program_that_calls_the_command_keeps_its_loggers():
    loggers = [logging.getLogger(name) for name in ("smartview_jax", "jax", "absl")]
    before = [logger.level for logger in loggers], list(loggers[0].handlers)
    assert run("-v", "schema", "dataset").exit_code == 0
    assert ([logger.level for logger in loggers], loggers[0].handlers) == before
