"""The rooms of the package import only from rooms below them, and only what these show.

A room is a package, or a file, directly in `smartview_jax`.
"""

import ast
import graphlib
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import smartview_jax

PACKAGE = Path(smartview_jax.__file__).parent

# From the ground floor up; `argument_checks` refuses what is of a wrong kind, `files` says only how
# files are read and written, `runtime` how programs are compiled, kept and interrupted, `extras`
# how optional packages are imported, `fit_result` how any fit ended, `schemas` what may stand in a
# file.
FLOORS = """
    argument_checks version files runtime extras fit_result
    schemas export_text geometry cameras targets robots robot_errors calibration dataset detection
    depth hand_eye data_checks staged engine variance joint arm_identification
    rig_starts rig_pipeline calibration_pipeline clocks evaluation viewpoints features
    modeling io recordings simulation fleet localization grasping plots report editor capture
    picking cli
    __main__
""".split()

NO_OPENCV = """
    runtime geometry cameras targets robots robot_errors calibration dataset
    hand_eye data_checks staged engine variance joint arm_identification viewpoints modeling
    localization
""".split()

NO_FACE = {"schemas", "runtime"}
"""A face would import what one of their files needs: pydantic for each kind of file, JAX."""

WRITE_PAGES = {"calibration_pipeline.py", "joint/pose_fit.py", "joint/rig_fit.py"}
"""Results that write their own page: `report` is above them, and they reach it by `smartview_jax`.

Nothing is imported before the page is asked for. Through the package's name a file could reach any
room, which only the command may do otherwise.
"""

LARGEST_SHARE = 0.15
"""Of the package's lines in one room: beyond it a room is two that nobody told apart."""


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


@cache
def tree_of(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


@cache
def nodes_of(file: Path) -> list[ast.AST]:
    return list(ast.walk(tree_of(file)))


@cache
def modules_of(file: Path, annotated: bool = True) -> list[tuple[str, list[str]]]:
    """Full name of every module that a file imports, at its top or inside a function, and what.

    Args:
        file: to be read.
        annotated: whether what is imported for annotations alone counts too.
    """
    folder = file.relative_to(PACKAGE.parent).parts[:-1]
    nodes = nodes_of(file)
    never_run = {
        inner
        for node in nodes
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    found = []
    for node in nodes if annotated else [n for n in nodes if n not in never_run]:
        if isinstance(node, ast.Import):
            found += [(alias.name, []) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            found.append((module, [alias.name for alias in node.names]))
    return found


def imports_of(file: Path) -> set[str]:
    """Full names of everything a file imports."""
    return {
        name
        for module, names in modules_of(file)
        for name in ([f"{module}.{part}" for part in names] or [module])
    }


def rooms_in(names: set[str]) -> set[str]:
    return {name.split(".")[1] for name in names if name.startswith("smartview_jax.")}


def files() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


FILES = files()


def place_of(module: str) -> Path:
    """Where a module would be, if it were a package."""
    return PACKAGE.parent.joinpath(*module.split("."))


def file_of(module: str) -> Path | None:
    """The file that a module is in; None where no module is called so."""
    place = place_of(module)
    return next((p for p in (place / "__init__.py", place.with_suffix(".py")) if p.exists()), None)


def needed_by(file: Path) -> set[Path]:
    """Files that have to be run before this one: of its own room files, of others their faces."""
    found = set()
    for module, names in modules_of(file, annotated=False):
        own = place_of(module) in file.parents
        parts = [file_of(f"{module}.{name}") for name in names] if own else []
        found |= {part or file_of(module) for part in parts or [None]}
    return found - {None, file}


def shares() -> dict[str, float]:
    lines = Counter()
    for file in files():
        lines[room_of(file)] += len(file.read_text(encoding="utf-8").splitlines())
    return {room: count / lines.total() for room, count in lines.most_common()}


def upward_imports(file: Path) -> set[str]:
    """Rooms above its own that a file imports from."""
    room = room_of(file)
    return {
        other
        for other in rooms_in(imports_of(file)) - {room}
        if other in FLOORS and FLOORS.index(other) > FLOORS.index(room)
    }


def imports_past_a_face(file: Path) -> set[str]:
    """Modules inside another room, or another sub-package, that a file imports from.

    A room's own face takes names from the files of its folders, so that none is listed twice.
    """
    ours = [name for name, _ in modules_of(file) if name.startswith("smartview_jax.")]
    inside = {file.parent} if file.name == "__init__.py" else set()
    return {
        name
        for name in ours
        if place_of(name).parent not in file.parents
        and not inside & set(place_of(name).parents)
        and not rooms_in({name}) <= NO_FACE
    }


def wrong_files(wrong_imports: Callable[[Path], set[str]]) -> dict[str, set[str]]:
    """What a rule finds in the files of the package, by file."""
    found = {str(file.relative_to(PACKAGE)): wrong_imports(file) for file in FILES}
    return {file: names for file, names in found.items() if names}


def test_every_room_is_in_the_plan():
    assert {room_of(file) for file in FILES} == set(FLOORS)


def test_rooms_import_only_from_rooms_below():
    assert not wrong_files(upward_imports)


def test_rooms_import_from_one_another_by_their_faces():
    assert not wrong_files(imports_past_a_face)


def test_only_the_command_and_results_with_a_page_reach_every_room():
    all_rooms = {
        str(file.relative_to(PACKAGE))
        for file in FILES
        if room_of(file) not in ("cli", "__main__") and "smartview_jax" in imports_of(file)
    }
    assert all_rooms == WRITE_PAGES


def test_no_files_import_one_another_in_a_circle():
    graphlib.TopologicalSorter({file: needed_by(file) for file in files()}).prepare()


def test_no_room_outgrows_the_others():
    large = {room: share for room, share in shares().items() if share > LARGEST_SHARE}
    words = [f"{room} {share:.0%}" for room, share in large.items()]
    assert not large, f"rooms too large: {words}"


def test_numerical_rooms_do_not_import_opencv():
    files = [file for file in FILES if room_of(file) in NO_OPENCV]
    assert len(files) > 100
    wrong = [file for file in files if "cv2" in {name.split(".")[0] for name in imports_of(file)}]
    assert not wrong


@pytest.fixture
def other_package(tmp_path, monkeypatch):
    """Writes files of a package that the checks then look at: one that cannot fail is no check."""
    monkeypatch.setattr("test_layers.PACKAGE", tmp_path / "smartview_jax")

    def write(name, text):
        file = tmp_path / "smartview_jax" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    return write


def test_the_test_sees_an_upward_import(other_package):
    wrong = other_package("geometry/wrong.py", "def f():\n    from ..joint.fit import fit_joint\n")
    assert upward_imports(wrong) == {"joint"}
    typed = "if TYPE_CHECKING:\n    from ..joint import JointFit\n"
    assert upward_imports(other_package("geometry/typed.py", typed)) == {"joint"}
    assert not upward_imports(other_package("joint/right.py", "from ..geometry import as_se3\n"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("joint/wrong.py", "from ..engine.solver import solve\n"),
        ("joint/inner/wrong.py", "from ...engine.solver import solve\n"),
        ("evaluation/diagnosis/wrong.py", "from ..held_out.folds import view_folds\n"),
        ("cli.py", "def f():\n    import smartview_jax.engine.solver\n"),
        ("joint/__init__.py", "from ..engine.solver import solve\n"),
    ],
)
def test_the_test_sees_an_import_past_a_face(other_package, name, text):
    assert imports_past_a_face(other_package(name, text))


@pytest.mark.parametrize("back", ["from .one import a\n", "from . import one\n"])
def test_the_test_sees_a_circle(other_package, back):
    other_package("joint/__init__.py", "from .one import a\n")
    other_package("joint/one.py", "def a():\n    from .two import b\n")
    other_package("joint/two.py", back)
    with pytest.raises(graphlib.CycleError):
        test_no_files_import_one_another_in_a_circle()


def test_the_test_sees_a_room_that_outgrew_the_others(other_package):
    for room in FLOORS[:8]:
        other_package(f"{room}.py", "1\n" * 10)
    test_no_room_outgrows_the_others()
    other_package("cli.py", "1\n" * 15)
    with pytest.raises(AssertionError, match="cli 16%"):
        test_no_room_outgrows_the_others()


def test_importing_starts_no_device():
    """Or `jax.distributed.initialize` would have to come before the import."""
    look = "from jax._src.xla_bridge import backends_are_initialized as started"
    code = f"import smartview_jax\n{look}\nraise SystemExit(started())"
    subprocess.run([sys.executable, "-c", code], check=True)
