"""The rooms of the package import only from rooms below them."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import smartview_jax

PACKAGE = Path(smartview_jax.__file__).parent

# From the ground floor up; `compilation` is how programs are compiled, `files` only the reading and
# writing of text, `fit_result` how any fit ended, `moved` where names were before, `schemas` what
# may stand in a file, `interrupts` how Ctrl-C ends a run.
FLOORS = """
    compilation files fit_result moved schemas geometry cameras targets robots robot_errors
    calibration dataset detection io simulation staged engine variance joint arm_identification
    calibrate_data evaluation viewpoints modeling localization grasping report editor interrupts cli
""".split()

NO_OPENCV = """
    compilation geometry cameras targets robots robot_errors calibration dataset staged engine
    variance joint arm_identification viewpoints
""".split()


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(file: Path) -> set[str]:
    """Full names of everything a file imports, at its top or inside a function."""
    folder = file.relative_to(PACKAGE.parent).parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def rooms_in(names: set[str]) -> set[str]:
    return {name.split(".")[1] for name in names if name.startswith("smartview_jax.")}


FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


@pytest.mark.parametrize("file", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_room_imports_only_from_rooms_below(file):
    room = room_of(file)
    assert room in FLOORS, f"{room} is not in the plan: the plan changes first"
    above = {
        other
        for other in rooms_in(imports_of(file)) - {room}
        if other in FLOORS and FLOORS.index(other) > FLOORS.index(room)
    }
    assert not above, f"{room} is below {above}"


@pytest.mark.parametrize("room", NO_OPENCV)
def test_numerical_rooms_do_not_import_opencv(room):
    names = {name for file in FILES if room_of(file) == room for name in imports_of(file)}
    assert not {name for name in names if name.split(".")[0] == "cv2"}


def test_the_test_sees_an_upward_import(tmp_path, monkeypatch):
    """A check that cannot fail is no check: feed it a wrong file."""
    monkeypatch.setattr("test_layers.PACKAGE", tmp_path / "smartview_jax")
    wrong = tmp_path / "smartview_jax" / "geometry" / "wrong.py"
    wrong.parent.mkdir(parents=True)
    wrong.write_text("def f():\n    from ..joint.fit import fit_joint\n")
    with pytest.raises(AssertionError, match="geometry is below"):
        test_a_room_imports_only_from_rooms_below(wrong)


def test_importing_starts_no_device():
    """Or `jax.distributed.initialize` would have to come before the import."""
    look = "from jax._src.xla_bridge import backends_are_initialized as started"
    code = f"import smartview_jax\n{look}\nraise SystemExit(started())"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_validation_library_is_imported_where_a_file_is_read():
    """It takes a tenth of a second, which `smartview --help` and a notebook's import do not owe."""
    code = "import sys, smartview_jax.cli\nraise SystemExit('pydantic' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
