"""What is imported, and when: the command and the package start without JAX."""

import importlib
import os
import subprocess
import sys

import pytest

import smartview_jax as sv

SLOW = {"jax", "matplotlib", "cv2", "scipy"}
"""Packages that take a tenth of a second or more to import; typer itself may import pydantic."""

CACHE_SETTINGS = {
    "JAX_COMPILATION_CACHE_DIR",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
    "JAX_DISABLE_MOST_OPTIMIZATIONS",
}
"""Where these tests keep their programs, and which: with other optimisation they are others."""

COMMAND = """
import atexit, sys
atexit.register(lambda: print(*(set({slow}) & set(sys.modules)), file=sys.stderr))
from smartview_jax.cli import app
app({words})
"""


def run(code, **settings):
    # A user's process, without this one's settings of JAX.
    environment = {name: value for name, value in os.environ.items() if "JAX" not in name}
    environment |= settings
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--help"], 0, "Calibrate cameras on robot arms"),
        (["calibrate", "--help"], 0, "calibration.yaml"),
        (["--version"], 0, sv.__version__),
        (["calibrate", "--lenz", "weng"], 2, "No such option"),
        (["calibrat"], 2, "No such command"),
    ],
)
def test_what_needs_no_data_loads_nothing_slow(words, code, said):
    done = run(COMMAND.format(slow=SLOW, words=words))
    assert done.returncode == code, done.stderr
    assert said in done.stdout + done.stderr
    assert done.stderr.splitlines()[-1] == ""


def test_the_package_alone_loads_nothing_slow():
    done = run(f"import sys, smartview_jax\nprint(set({SLOW}) & set(sys.modules))")
    assert done.stdout == "set()\n"


def test_every_public_name_is_listed_and_there():
    """What the stub says, which type checkers and editors read, is what is found."""
    assert {"Camera", "Dataset", "calibrate", "load_dataset", "io", "robots"} <= set(dir(sv))
    assert set(sv.__all__) <= set(dir(sv))
    for name in dir(sv):
        assert getattr(sv, name) is not None
    with pytest.raises(AttributeError, match="never"):
        _ = sv.never


def test_a_public_name_is_that_of_its_room():
    assert sv.Camera is importlib.import_module("smartview_jax.cameras").Camera
    assert sv.cameras is importlib.import_module("smartview_jax.cameras")
    assert sv.held_out is importlib.import_module("smartview_jax.evaluation").held_out


def test_a_default_calibration_has_few_programs_to_compile(tmp_path):
    """A count, not a time: every program costs a newcomer a part of the first answer's seconds.

    Programs that other tests compiled are read, which counts as building them, too.
    """
    done = run(
        f"""
import jax, smartview_jax as sv
from smartview_jax.cli import app
from smartview_jax.io import sample_folder
built = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: built.append(event)
    if event.endswith(("backend_compile_duration", "program_read"))
    else 0
)
data = sv.load_dataset(sample_folder())
assert not built, "reading the data compiles nothing"
fit = sv.calibrate(data)
first = len(built)
assert fit.result.converged
sv.calibrate(data)
again = len(built) - first
sv.calibrate(data.select(range(13)))
fewer_views = len(built) - first - again
before = len(built)
app(["calibrate", "--out", {str(tmp_path / "out")!r}], standalone_mode=False)
print(first, again, fewer_views, len(built) - before)
""",
        **{name: value for name, value in os.environ.items() if name in CACHE_SETTINGS},
    )
    assert done.returncode == 0, done.stderr
    first, again, fewer_views, folds_and_report = map(int, done.stdout.splitlines()[-1].split())
    assert 10 < first <= 18, first
    assert again == 0
    # Padded to the same size; the error field that is chosen may be another.
    assert fewer_views <= 2, fewer_views
    assert folds_and_report <= 4, folds_and_report
