"""The main job: `smartview calibrate` on the package's sample, in a process like a user's."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from once_a_run import made_once

CACHE_SETTINGS = {
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_DISABLE_MOST_OPTIMIZATIONS",
    "JAX_TRACEBACK_IN_LOCATIONS_LIMIT",
    "XLA_FLAGS",
}
"""Where these tests keep their programs, and which: with other optimisation they are others."""

SCRIPT = """
import json, sys
import jax
import smartview_jax.cli.calibrate_folder as command
from smartview_jax.cli import app

built, load = [], command.load_named
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: built.append(event)
    if event.endswith(("backend_compile_duration", "program_read"))
    else 0
)

def counted(*arguments, **options):
    found = load(*arguments, **options)
    counts["loading"] = len(built)
    return found

counts, command.load_named = {}, counted
try:
    app(["calibrate", "--out", sys.argv[1] + "/out"])
finally:
    counts["all"] = len(built)
    with open(sys.argv[1] + "/counts.json", "w") as file:
        json.dump(counts, file)
"""


class MainJob(NamedTuple):
    """What the command left.

    Attributes:
        exit_code: of the process.
        stdout: what it printed.
        stderr: what it said meanwhile.
        programs: numbers of XLA programs that were compiled or read, to load the data and in all.
        out: folder of the results.
    """

    exit_code: int
    stdout: str
    stderr: str
    programs: dict[str, int]
    out: Path


def user_environment(**settings):
    """The variables of a user's process, without this one's settings of JAX and XLA."""
    given = ("JAX", "XLA")
    return {k: v for k, v in os.environ.items() if not k.startswith(given)} | settings


def main_job(tmp_path_factory):
    """The main job's results, which are only to be read."""
    folder = made_once(tmp_path_factory, "main_job", _run)
    said = json.loads((folder / "said.json").read_text())
    programs = json.loads((folder / "counts.json").read_text())
    return MainJob(*said, programs, folder / "out")


def _run(folder):
    folder.mkdir()
    kept = {name: value for name, value in os.environ.items() if name in CACHE_SETTINGS}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder)],
        capture_output=True,
        text=True,
        env=user_environment(**kept),
    )
    said = [done.returncode, done.stdout, done.stderr]
    (folder / "said.json").write_text(json.dumps(said))
