"""Bugs put into the package on purpose: the tests of its rooms have to notice each of them.

python -m benchmarks.mutations                          # all of `mutations.yaml`
python -m benchmarks.mutations --room staged            # of one room; of one file by its name
python -m benchmarks.mutations --results found.json     # go on where an earlier run ended
python -m benchmarks.mutations --tests ../other/tests   # with the tests of another revision

The package is copied to a temporary folder; the checkout is never changed. One bug at a time is put
into the copy, and pytest runs the tests of the bug's room until one fails.
"""

import argparse
import hashlib
import json
import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).parent.parent

LIST = Path(__file__).with_name("mutations.yaml")

SMOKE_NAMES = ("tags_numbered_from_one", "asymmetric_grid_counts_columns")
"""Mutations whose tests take seconds."""

TOP_LEVEL = "top"
"""The name for the modules that are in no room; each has a test file of its own."""

TIME_LIMIT = 1800.0
"""Longest time of one run of pytest, s. A bug that makes a program run forever is noticed, too."""

NOT_COPIED = (".*", "__pycache__", "*.egg-info", "build", "dist")


class Mutation(NamedTuple):
    """A bug that a person could make.

    Attributes:
        name: a name for tables and options.
        file: path of the module inside the package.
        wrong: a sentence on what is wrong.
        old: text that occurs exactly once in the file.
        new: what takes its place.
        first: files of the room's tests, or tests as `file::test`, that most likely notice it.
    """

    name: str
    file: str
    wrong: str
    old: str
    new: str
    first: tuple[str, ...] = ()

    @property
    def room(self) -> str:
        """The room of the module."""
        return self.file.split("/")[0] if "/" in self.file else TOP_LEVEL

    @property
    def tests(self) -> Path:
        """The folder of the room's tests, or the file of a module that is in no room."""
        path = Path("tests", self.room)
        return path if self.room != TOP_LEVEL else Path("tests", f"test_{self.file}")

    @property
    def digest(self) -> str:
        """A checksum of the bug, by which a result is known to be about this one."""
        content = "\0".join((self.file, self.old, self.new))
        return hashlib.sha256(content.encode()).hexdigest()[:16]


class Outcome(NamedTuple):
    """What the tests said of a mutation.

    Attributes:
        name: of the mutation.
        digest: of the mutation.
        state: "killed", "survived", "stale" (the old text is not in the file exactly once), "no
            tests", "broken" (pytest did not run) or "fails anyway" (without the mutation too).
        test: that noticed it, or a sentence on what went wrong.
        seconds: processor time of pytest and its processes.
    """

    name: str
    digest: str
    state: str
    test: str
    seconds: float


def mutations() -> list[Mutation]:
    """Return the list of all mutations."""
    entries = yaml.safe_load(LIST.read_text(encoding="utf-8"))
    found = [Mutation(**entry | {"first": tuple(entry.get("first", ()))}) for entry in entries]
    twice = [name for name, count in Counter(one.name for one in found).items() if count > 1]
    if twice:
        raise ValueError(f"{LIST.name}: more than one mutation is called {', '.join(twice)}")
    return found


def applies(mutation: Mutation, path: Path) -> bool:
    """Return whether the old text of a mutation is in a file, and once only."""
    return path.is_file() and path.read_text(encoding="utf-8").count(mutation.old) == 1


class Copy:
    """A copy of the checkout in which one file at a time is changed."""

    def __init__(self, folder: Path, tests: Path, programs: Path):
        """Copy the checkout.

        Args:
            folder: to create.
            tests: folder of tests to take in the place of the checkout's own; the settings of
                pytest come from the folder that it is in.
            programs: folder for compiled programs, which all runs share.
        """
        self.folder = folder
        self._programs = programs
        ignored = shutil.ignore_patterns(*NOT_COPIED, "tests")
        shutil.copytree(ROOT, folder, ignore=ignored)
        shutil.copytree(tests, folder / "tests", ignore=shutil.ignore_patterns(*NOT_COPIED))
        settings = tests.resolve().parent / "pyproject.toml"
        shutil.copy2(settings if settings.is_file() else ROOT / "pyproject.toml", folder)

    def put(self, mutation: Mutation) -> bool:
        """Put a mutation into its file; return False where its old text is not there once."""
        path = self.folder / "smartview_jax" / mutation.file
        if not applies(mutation, path):
            return False
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
        # Compiled files of Python, and programs that were kept, tell versions by seconds and size.
        stamp = os.stat(self._original(mutation)).st_mtime + 1 + int(mutation.digest[:4], 16)
        os.utime(path, (stamp, stamp))
        return True

    def restore(self, mutation: Mutation) -> None:
        """Make a mutated file what it was."""
        shutil.copy2(self._original(mutation), self.folder / "smartview_jax" / mutation.file)

    def _original(self, mutation: Mutation) -> Path:
        return ROOT / "smartview_jax" / mutation.file

    def pytest(self, *words: str) -> tuple[int, str, float]:
        """Run tests one after the other until one fails; return code, output and seconds."""
        environment = os.environ | {"PYTHONPATH": str(self.folder)}
        environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(self._programs))
        command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "-rfE", *words]
        with tempfile.TemporaryFile() as output:
            process = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=output, stderr=output
            )
            timer = threading.Timer(TIME_LIMIT, process.kill)
            timer.start()
            # Unlike `process.wait` it tells the processor time.
            _, status, usage = os.wait4(process.pid, 0)
            timer.cancel()
            process.returncode = os.waitstatus_to_exitcode(status)
            output.seek(0)
            text = output.read().decode(errors="replace")
        return process.returncode, text, usage.ru_utime + usage.ru_stime


KILLED, PASSED, INTERRUPTED, NO_TESTS = 1, 0, 2, 5
"""Exit codes of pytest; it is interrupted by a module that cannot be imported."""


def outcome_of(mutation: Mutation, copy: Copy, control: bool = False) -> Outcome:
    """Return what the tests of its room say of a mutation.

    Args:
        mutation: to try.
        copy: of the checkout, without any mutation, as it is again afterwards.
        control: whether the test that noticed it is run without the mutation, too.
    """
    if not copy.put(mutation):
        text = "its old text is not in the file exactly once"
        return Outcome(mutation.name, mutation.digest, "stale", text, 0.0)
    try:
        code, text, seconds = _tests_of_room(mutation, copy)
    finally:
        copy.restore(mutation)
    failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", text, re.MULTILINE)
    test = failed[0] if failed else ""
    if code < 0:
        state, test = "killed", f"it was ended after {TIME_LIMIT:.0f} s, or crashed"
    elif code in (KILLED, INTERRUPTED) and failed:
        state = "killed"
        # A test that fails without the mutation, too, has not noticed it.
        if control:
            code, _, more = copy.pytest(test)
            seconds += more
            state = "killed" if code == PASSED else "fails anyway"
    else:
        state = {PASSED: "survived", NO_TESTS: "no tests"}.get(code, "broken")
        test = "" if state != "broken" else " ".join(text.split())[-200:]
    return Outcome(mutation.name, mutation.digest, state, test, round(seconds, 1))


def _tests_of_room(mutation: Mutation, copy: Copy) -> tuple[int, str, float]:
    """Run the tests of a mutation's room, the most likely files before the others."""
    room = mutation.tests
    if not (copy.folder / room).exists():
        return NO_TESTS, "", 0.0
    folder = room if mutation.room != TOP_LEVEL else room.parent
    first = [f"{folder}/{name}" for name in mutation.first if _is_there(copy.folder / folder, name)]
    others = [str(room), *(f"--ignore={path}" for path in first if "::" not in path)]
    code, text, total = NO_TESTS, "", 0.0
    for words in (first, others) if first else (others,):
        code, text, seconds = copy.pytest(*words)
        total += seconds
        if code not in (PASSED, NO_TESTS):
            break
    # A room may have no other files.
    return PASSED if first and code == NO_TESTS else code, text, total


def _is_there(room: Path, name: str) -> bool:
    """Return whether a room has a test file, or a test in it; another revision may have others."""
    file, _, test = name.partition("::")
    path = room / file
    return path.is_file() and (not test or f"def {test}(" in path.read_text(encoding="utf-8"))


def outcomes(
    chosen: Sequence[Mutation],
    tests: Path | None = None,
    results: Path | None = None,
    jobs: int = 1,
    control: bool = False,
) -> list[Outcome]:
    """Return what the tests say of mutations, and print each when it is known.

    Args:
        chosen: the mutations.
        tests: folder of tests of another revision; by default the checkout's own.
        results: file with the outcomes of earlier runs; this run's are added.
        jobs: number of mutations that are tried at the same time.
        control: as for `outcome_of`.
    """
    known = {}
    if results is not None and results.is_file():
        entries = json.loads(results.read_text(encoding="utf-8"))
        # What is no longer in the list is forgotten.
        names = {one.name for one in mutations()}
        known = {one["name"]: Outcome(**one) for one in entries if one["name"] in names}
    found = {
        one.name: known[one.name]
        for one in chosen
        if one.name in known and known[one.name].digest == one.digest
    }
    left = [one for one in chosen if one.name not in found]
    lock, copies = threading.Lock(), queue.SimpleQueue[Copy]()
    with tempfile.TemporaryDirectory(prefix="mutations.") as name:
        folder = Path(name)
        _link_data(folder)
        for k in range(min(jobs, len(left))):
            copies.put(Copy(folder / f"copy{k}", tests or ROOT / "tests", folder / "programs"))

        def attempt(mutation: Mutation) -> None:
            copy = copies.get()
            outcome = outcome_of(mutation, copy, control)
            copies.put(copy)
            with lock:
                found[mutation.name] = outcome
                print(_row(mutation, outcome), flush=True)
                if results is not None:
                    _write(results, known | found)

        with ThreadPoolExecutor(max(jobs, 1)) as workers:
            list(workers.map(attempt, left))
    return [found[one.name] for one in chosen]


def _link_data(folder: Path) -> None:
    """Let the copies find the real data sets where a checkout finds them."""
    (folder / "programs").mkdir()
    data = ROOT.parent / "shared"
    if data.is_dir():
        (folder / "shared").symlink_to(data, target_is_directory=True)


def _write(path: Path, found: dict[str, Outcome]) -> None:
    """Write outcomes, so that a run that ends half-way leaves the older file or the newer one."""
    temporary = path.with_name(path.name + ".new")
    text = json.dumps([outcome._asdict() for outcome in found.values()], indent=1)
    temporary.write_text(text + "\n", encoding="utf-8")
    os.replace(temporary, path)


def _row(mutation: Mutation, outcome: Outcome) -> str:
    """Return a row of the table."""
    return (
        f"  {mutation.room:18} {outcome.name:42} {outcome.state:12} {outcome.seconds:7.1f} s  "
        f"{outcome.test.removeprefix('tests/')}"
    )


def run(
    smoke: bool = False,
    names: Sequence[str] = (),
    rooms: Sequence[str] = (),
    tests: Path | None = None,
    results: Path | None = None,
    jobs: int = 1,
    control: bool = False,
) -> bool:
    """Print which tests notice which mutation; True where every mutation is noticed."""
    names = names or (SMOKE_NAMES if smoke else ())
    chosen = [
        one
        for one in mutations()
        if (not names or one.name in names) and (not rooms or one.room in rooms)
    ]
    found = outcomes(chosen, tests, results, jobs, control)
    missed = [one for one in zip(chosen, found, strict=True) if one[1].state != "killed"]
    seconds = sum(one.seconds for one in found)
    print(f"{len(found) - len(missed)} of {len(found)} mutations killed, {seconds:.0f} s")
    for mutation, outcome in missed:
        print(f"{outcome.state}: {mutation.name} ({mutation.file}): {mutation.wrong}")
    # A change of the package leaves mutations behind that nobody tries until all of them are run.
    package = ROOT / "smartview_jax"
    stale = [one for one in mutations() if not applies(one, package / one.file)] if smoke else []
    for mutation in stale:
        print(f"no longer applies: {mutation.name} ({mutation.file})")
    return bool(found) and not missed and not stale


if __name__ == "__main__":
    everything = mutations()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutations")
    parser.add_argument("names", nargs="*", metavar="NAME", help="mutations; all by default")
    parser.add_argument("--room", action="append", default=[], help="only mutations of this room")
    parser.add_argument("--tests", type=Path, metavar="DIR", help="tests of another revision")
    parser.add_argument("--results", type=Path, metavar="FILE", help="outcomes, to go on from")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="mutations at a time")
    parser.add_argument(
        "--control", action="store_true", help="run each killing test without the mutation, too"
    )
    arguments = parser.parse_args()
    unknown = set(arguments.names) - {one.name for one in everything}
    unknown |= set(arguments.room) - {one.room for one in everything}
    if unknown:
        parser.error(f"there is no mutation and no room called {', '.join(sorted(unknown))}")
    sys.exit(
        not run(
            names=arguments.names,
            rooms=arguments.room,
            tests=arguments.tests,
            results=arguments.results,
            jobs=arguments.jobs,
            control=arguments.control,
        )
    )
