"""The joint fit against other libraries: each in a process of its own, interleaved, one table.

Peers that are not installed are reported as missing. Ceres in C++ is compiled here where `g++` and
its headers are found (Debian: libceres-dev). vision-calibration runs all its stages, with a lens of
its own.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .gate import check
from .peers.problem import SIZES, make

HERE = Path(__file__).parent
ROUNDS = 2
PAPERS_LENS = "  its paper's lens"
SOLVE_ALONE = "  its solve alone"
PYTHON_PEERS = {
    "scipy": ("scipy_trf", "scipy"),
    "pyceres": ("pyceres_lm", "pyceres"),
    "gtsam": ("gtsam_lm", "gtsam"),
    "casadi with ipopt": ("casadi_ipopt", "casadi"),
    "jaxls": ("jaxls_lm", "jaxls"),
    "vision-calibration": ("vision_calibration_ba", "vision_calibration"),
}
"""Module here, and the package it needs."""

AGREE = 1e-9
"""Relative difference of final costs that counts as the same optimum."""

ASKED = {
    "scipy": "abf",
    "pyceres": "abcdef",
    "gtsam": "abcd",
    "casadi with ipopt": "abc",
    "jaxls": "bcd",
    "vision-calibration": "ab",
    PAPERS_LENS: "abcde",
    SOLVE_ALONE: "abcde",
    "Ceres C++, 2 threads": "abcde",
    "smartview_jax": "abcde",
    "smartview_jax, many": "f",
    "  on 2 devices": "f",
}
"""Problems that a peer is asked for; the others would take minutes or are not written for it."""


def run(smoke: bool = False) -> bool:
    """Print the table; True where all peers reach the same cost and the baseline is kept."""
    sizes = {"a": (5, 1000, False), "d": (8, 100, True), "f": (5, 100, False)} if smoke else SIZES
    with tempfile.TemporaryDirectory() as folder:
        peers = _peers(Path(folder))
        print(
            f"{'problem':9}{'peer':22}{'seconds':>10}{'ratio':>8}{'MB':>7}{'steps':>7}{'cold':>7}"
        )
        figures: dict[str, float] = {}
        same = [_problem(name, sizes[name], Path(folder), peers, smoke, figures) for name in sizes]
    return all(same) and (check(figures) if smoke else True)


def _problem(
    name: str,
    size: tuple[int, int, bool],
    folder: Path,
    peers: dict[str, Callable],
    smoke: bool,
    figures: dict[str, float],
) -> bool:
    path = folder / f"{name}.f64"
    make(*size).save(path)
    results: dict[str, list[dict]] = {}
    repeats = 2 if smoke else max(3, 100_000 // (size[0] * size[1]))
    for _ in range(1 if smoke else ROUNDS):
        for peer, command in peers.items():
            if name in ASKED.get(peer, name):
                results.setdefault(peer, []).append(measured(command(path, repeats)))
    path.unlink()
    ours = next(iter(results.values()))
    base = median(ours, "seconds")
    figures[f"{name}: solver steps"] = median(ours, "iterations")
    figures[f"{name}: peak memory, MB"] = median(ours, "peak_mb")
    if "scipy" in results:
        figures[f"{name}: times as fast as scipy"] = median(results["scipy"], "seconds") / base
    for peer, found in results.items():
        seconds = median(found, "seconds")
        print(
            f"{name:9}{peer:22}{seconds:10.5f}{seconds / base:8.2f}{median(found, 'peak_mb'):7.0f}"
            f"{median(found, 'iterations'):7.0f}{median(found, 'cold'):7.2f}"
        )
    same = [found[-1] for peer, found in results.items() if peer != PAPERS_LENS]
    costs = [one["cost"] for one in same if one["cost"] is not None]
    gap = max(costs) / min(costs) - 1.0
    print(f"{name:9}costs differ by {gap:.1e} of their value")
    return gap < AGREE


def _peers(folder: Path) -> dict[str, Callable[[Path, int], list[str]]]:
    found = {
        "smartview_jax": python("smartview", "forward", "fit_joint"),
        SOLVE_ALONE: python("smartview", "forward", "solve"),
        PAPERS_LENS: python("smartview", "radial", "fit_joint"),
        "smartview_jax, many": python("smartview_many", "1"),
        "  on 2 devices": python("smartview_many", "2"),
    }
    for name, (module, package) in PYTHON_PEERS.items():
        if importlib.util.find_spec(package) is None:
            print(f"missing: {name}")
        else:
            found[name] = python(module)
    program = _compiled(folder)
    if program is None:
        print("missing: Ceres in C++ (g++ and libceres-dev)")
    else:
        for threads in (1, 2):
            found[f"Ceres C++, {threads} thread{'s'[: threads - 1]}"] = (
                lambda path, repeats, t=threads: [program, str(path), str(repeats), str(t)]
            )
    return found


def _compiled(folder: Path) -> str | None:
    if shutil.which("g++") is None:
        return None
    program = folder / "ceres_native"
    source = HERE / "peers" / "ceres_native.cpp"
    flags = ["-O3", "-march=native", "-std=c++17", "-I/usr/include/eigen3"]
    libraries = ["-lceres", "-lglog", "-lgflags", "-pthread"]
    done = subprocess.run(
        ["g++", *flags, str(source), "-o", str(program), *libraries], capture_output=True
    )
    return str(program) if done.returncode == 0 else None


def python(module: str, *more: str) -> Callable[[Path, int], list[str]]:
    """The command that runs a peer written in Python, by problem and number of repeats."""
    start = [sys.executable, "-m", f"benchmarks.peers.{module}"]
    return lambda path, repeats: [*start, str(path), str(repeats), *more]


def measured(command: list[str], platform: str | None = None) -> dict:
    """What a peer printed, run in a process of its own, on a platform such as "cpu" or "cuda"."""
    environment = {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "0"}
    if platform is not None:
        environment["JAX_PLATFORMS"] = platform
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE.parent, env=environment)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def median(found: list[dict], key: str) -> float:
    """Of one figure over all runs."""
    return float(np.median(np.concatenate([np.atleast_1d(one[key]) for one in found])))
