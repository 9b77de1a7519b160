"""The time to a first answer: each job in a fresh process, without and with compiled programs kept.

The jobs are `smartview --help`, imports, `sv.calibrate` of the sample, the whole command
`smartview calibrate`, and a notebook's second fit, on fewer views than the first. Every process
has its yardstick, a fixed JAX program that is compiled before and after it: on a machine that does
other things besides, seconds differ from minute to minute, but hardly their ratio to the
yardstick's. "--against REV" measures another revision of this repository in turn with this one.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
JOB = Path(__file__).parent / "startup_job.py"

JOBS = (
    "smartview --help",
    "import jax",
    "import smartview_jax",
    "import sv.calibrate",
    "sv.calibrate(sample)",
    "smartview calibrate",
    "second fit",
)
SMOKE = JOBS[:4]

COMPILING = JOBS[4:]
"""Those that compile programs, and are done again with what was kept."""

COLUMNS = {
    "wall": "wall s",
    "processor": "proc s",
    "yardsticks": "yardst.",
    "programs": "progr.",
    "hits": "read",
    "trace": "trace s",
    "lower": "lower s",
    "compile": "comp. s",
    "retrieve": "read s",
    "run": "rest s",
    "peak_mb": "MB",
}
"""Heading of every figure; `yardsticks` is processor time over the yardstick's, `hits` the programs
that were read instead of compiled, `run` the rest of the wall time."""

PROGRAMS = 60
"""Largest number of programs that a default `sv.calibrate` may need."""

HELP_SHARE = 0.4
"""Largest processor time of `--help`, as a share of the yardstick's."""

Figures = dict[str, float]


def run(smoke: bool = False, against: str | None = None) -> bool:
    """Print the table; True where `--help` is quick and the first fit needs few programs."""
    with _trees(against) as trees:
        table = _measured(trees, SMOKE if smoke else JOBS)
    print(f"{'job':22}{'kept':6}{'tree':10}" + "".join(f"{x:>9}" for x in COLUMNS.values()))
    for (job, kept), found in table.items():
        for tree, figures in found.items():
            _print_row(job, kept, tree, figures)
        if len(found) > 1:
            ours, theirs = found.values()
            ratios = {name: ours[name] / theirs[name] for name in ours if theirs.get(name)}
            _print_row(job, kept, "ratio", ratios, ratio=True)
    good = table[JOBS[0], "no"]["here"]["yardsticks"] <= HELP_SHARE
    if not smoke:
        good &= table["sv.calibrate(sample)", "no"]["here"]["programs"] <= PROGRAMS
    return good


@contextmanager
def _trees(against: str | None) -> Iterator[dict[str, Path]]:
    """Yield this tree and another revision's in a temporary folder, by their names in the table."""
    if against is None:
        yield {"here": ROOT}
        return
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), against], check=True)
        try:
            yield {"here": ROOT, against[:9]: tree}
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def _measured(
    trees: dict[str, Path], jobs: tuple[str, ...]
) -> dict[tuple[str, str], dict[str, Figures]]:
    """The figures of every tree, by job and by whether compiled programs were kept before."""
    table: dict[tuple[str, str], dict[str, Figures]] = {}
    for tree in trees.values():
        # Else the first process alone would translate every file of the package for Python.
        subprocess.run([sys.executable, "-m", "compileall", "-q", tree / "smartview_jax"])
    _process("yardstick", ROOT, None)
    before = _process("yardstick", ROOT, None)
    for job in jobs:
        with tempfile.TemporaryDirectory() as caches:
            for kept in ("no", "yes") if job in COMPILING else ("no",):
                for name, tree in trees.items():
                    figures = _process(job, tree, Path(caches) / name)
                    after = _process("yardstick", ROOT, None)
                    yardstick = 0.5 * (before["processor"] + after["processor"])
                    figures["yardsticks"] = figures["processor"] / yardstick
                    table.setdefault((job, kept), {})[name] = figures
                    before = after
    return table


def _process(job: str, tree: Path, cache: Path | None) -> Figures:
    """Figures of a job in a process of its own; seconds and memory are the whole process's."""
    # No setting of this process's own, and nothing is kept where a user keeps it.
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    environment |= {"PYTHONPATH": str(tree), "XDG_CACHE_HOME": str(cache)}
    if cache is None:
        environment["JAX_ENABLE_COMPILATION_CACHE"] = "0"
    with tempfile.TemporaryDirectory() as folder:
        result, log = Path(folder) / "result.json", Path(folder) / "log.txt"
        with log.open("w") as output:
            began = time.perf_counter()
            process = subprocess.Popen(
                # Without -P, Python would take the files next to the script for its own modules.
                [sys.executable, "-P", str(JOB), job, str(result), folder],
                env=environment,
                cwd=folder,
                stdout=output,
                stderr=output,
            )
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode != 0:
            raise RuntimeError(f"{job} failed in {tree}:\n{log.read_text()[-2000:]}")
        whole = {
            "wall": time.perf_counter() - began,
            "processor": used.ru_utime + used.ru_stime,
            "peak_mb": used.ru_maxrss / 1024.0,
        }
        inside = json.loads(result.read_text()) if result.exists() else {}
        # A second fit, and the yardstick, are only part of their process.
        return whole | inside if job in ("second fit", "yardstick") else inside | whole


def _print_row(job: str, kept: str, tree: str, figures: Figures, ratio: bool = False) -> None:
    cells = [figures.get(name, np.nan) for name in COLUMNS]
    places = [2 if ratio or name not in ("programs", "hits", "peak_mb") else 0 for name in COLUMNS]
    texts = (
        f"{'-' if np.isnan(cell) else f'{cell:.{place}f}':>9}"
        for cell, place in zip(cells, places, strict=True)
    )
    print(f"{job:22}{kept:6}{tree:10}" + "".join(texts))
