"""Tell which checks have to be run again because their sources changed since they last passed.

Usage: python .ci/sources.py changed KIND      # print the names, one per line
       python .ci/sources.py passed KIND ...   # record that these checks pass with today's sources

A check is a notebook, a benchmark's small run, the demo, or the tests of the rooms that touch
OpenCV. Its sources are all files that it imports, directly or through others, the data of the
packages that they stand in, and the versions of the dependencies. A digest of them is kept in
`.ci/verified.json` when the check has passed. What starts processes of its own depends on the
whole package.
"""

import ast
import hashlib
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "smartview_jax"
RECORD = ROOT / ".ci" / "verified.json"

ALWAYS = [PACKAGE / "__init__.py", PACKAGE / "__init__.pyi", PACKAGE / "samples"]
"""Files and folders that are read by everything that imports the package."""

PAGE_WRITERS = {
    PACKAGE / name for name in ("calibration_pipeline.py", "joint/pose_fit.py", "joint/rig_fit.py")
}
"""Results whose `report` writes a page: only what calls it needs the room `report`."""

VERSIONS = [ROOT / "pyproject.toml", ROOT / ".ci" / "constraints.txt"]

OPENCV_ROOMS = ("detection", "io", "simulation", "cameras", "features", "recordings")
"""Rooms whose tests run under the oldest and the newest version of OpenCV."""


def checks() -> dict[str, list[Path]]:
    """Files that each check starts from, by the check's name, such as `benchmarks/engine`."""
    benchmarks = ast.parse((ROOT / "benchmarks" / "__main__.py").read_text("utf-8"))
    names = next(
        ast.literal_eval(node.value)
        for node in benchmarks.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "BENCHMARKS"
    )
    opencv_tests = [file for room in OPENCV_ROOMS for file in (ROOT / "tests" / room).rglob("*.py")]
    comparison = ROOT / ".ci" / "compare_notebooks.py"
    return {
        **{f"notebooks/{file.stem}": [file, comparison] for file in ROOT.glob("notebooks/*.ipynb")},
        **{f"benchmarks/{name}": [ROOT / "benchmarks" / f"{name}.py"] for name in names},
        "demo": [PACKAGE / "cli" / "demo.py", PACKAGE / "cli" / "__init__.py"],
        "opencv5": [ROOT / "tests" / "conftest.py", *opencv_tests],
    }


def python_text(file: Path) -> str:
    """The Python in a file: its text, or the code of a notebook without IPython's own commands."""
    text = file.read_text("utf-8")
    if file.suffix != ".ipynb":
        return text
    cells = json.loads(text)["cells"]
    lines = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "code").splitlines()
    return "\n".join("pass" if line.lstrip()[:1] in ("%", "!") else line for line in lines)


@cache
def files_of(module: str) -> frozenset[Path]:
    """The file of a module in this repository, and the faces of the packages around it.

    What a package shows is imported when it is used: the stub lists its files.
    """
    parts = module.split(".")
    found = set()
    for base in (ROOT, ROOT / "tests"):
        for count in range(1, len(parts) + 1):
            place = base.joinpath(*parts[:count])
            faces = place / "__init__.py", place / "__init__.pyi"
            for file in (*faces, place.with_suffix(".py")):
                if file.is_file() and (count > 1 or file.parent != PACKAGE):
                    found.add(file)
    return frozenset(found)


@cache
def kept_files() -> frozenset[Path]:
    """Files of the repository; what a run leaves next to them, and Git ignores, is no source."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return frozenset(file for name in listed.split("\0") if (file := ROOT / name).is_file())


@cache
def public_names() -> dict[str, str]:
    """The module that each public name of the package stands in, from its stub."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text("utf-8"))
    return {
        alias.name: f"{PACKAGE.name}.{node.module or alias.name}"
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


@cache
def imported_files(file: Path) -> frozenset[Path]:
    """Files of this repository that a file names in imports, at its top or inside a function."""
    nodes = list(ast.walk(ast.parse(python_text(file))))
    folder = file.parent.relative_to(ROOT).parts
    modules, package_names = set(), set()
    for node in nodes:
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
            package_names |= {a.asname or a.name for a in node.names if a.name == PACKAGE.name}
        elif isinstance(node, ast.ImportFrom):
            outer = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join([*outer, *([node.module] if node.module else [])])
            modules |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    # `sv.fit_joint` stands where the package's stub says.
    modules |= {
        public_names()[node.attr]
        for node in nodes
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in package_names
        and node.attr in public_names()
    }
    report = public_names()["report"]
    methods = {
        node.func.attr
        for node in nodes
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    }
    if file in PAGE_WRITERS:
        modules.discard(report)
    elif "report" in methods:
        modules.add(report)
    for module in list(modules):
        package, _, name = module.partition(".")
        if package == PACKAGE.name and name in public_names():
            modules.add(public_names()[name])
    found = {found for module in modules for found in files_of(module)}
    if "subprocess" in modules:
        found |= set(PACKAGE.rglob("*.py"))
    return frozenset(found)


def sources(starts: list[Path]) -> set[Path]:
    """All files that a check depends on."""
    found, waiting = set(), list(starts)
    while waiting:
        file = waiting.pop()
        if file not in found:
            found.add(file)
            waiting += imported_files(file)
    folders = {file.parent for file in found if PACKAGE in file.parents} - {PACKAGE}
    data = {
        file
        for file in kept_files()
        if file.suffix != ".py" and not folders.isdisjoint(file.parents)
    }
    always = {
        file for file in kept_files() if not {file, *file.parents}.isdisjoint([*ALWAYS, *VERSIONS])
    }
    return found | data | always


def digest(starts: list[Path]) -> str:
    """A digest of the names and the contents of a check's sources."""
    total = hashlib.sha256()
    for file in sorted(sources(starts)):
        total.update(str(file.relative_to(ROOT)).encode() + b"\0")
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()[:16]


def of_kind(kind: str) -> dict[str, str]:
    """Digests of the checks of a kind (`notebooks`, `benchmarks`, `demo`, `opencv5`), by name."""
    found = {
        name: digest(starts) for name, starts in checks().items() if name.split("/")[0] == kind
    }
    if not found:
        raise SystemExit(f"no checks are of kind {kind!r}")
    return found


def main() -> None:
    """Print which checks changed, or record those that passed."""
    action, *kinds = sys.argv[1:]
    record = json.loads(RECORD.read_text("utf-8")) if RECORD.is_file() else {}
    if action == "passed":
        kept = {name: value for name, value in record.items() if name.split("/")[0] not in kinds}
        today = {name: value for kind in kinds for name, value in of_kind(kind).items()}
        RECORD.write_text(json.dumps(kept | today, indent=2, sort_keys=True) + "\n", "utf-8")
    elif action == "changed":
        for name, value in of_kind(*kinds).items():
            if record.get(name) != value:
                sys.stdout.write(name.split("/")[-1] + "\n")
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
