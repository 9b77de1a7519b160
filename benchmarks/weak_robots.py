"""From an exact robot to a very weak one: is the default ever worse than the best simple fit?

A robot with white noise alone sees a small board with 20 points. Nothing in its pictures says how
large the world is, so a fit that gains by making it smaller loses everything: target, motion and
noise go to zero together. Compared are the default, the staged fit, the joint fit that trusts the
robot, and the joint fit with white noise alone, with the camera known and unknown, on 8 to 2,000
views. Printed are RMS errors over the seeds on 40 unseen views (px) and of the hand-eye translation
(mm), and the default's ratio to the best of the three; an exact robot is compared with the fit that
trusts it. The last row is a real weak robot, 74 views of ur5e_kinect_78, in five folds.

    python -m benchmarks weak_robots --results build/weak_robots.jsonl
    python -m benchmarks.weak_robots --seeds 2 --views 8 20 60

The real robot is left out where only some numbers of views are asked for. With `--results` every
run is written to the file when it is done, and runs that it holds are not made again: an
interrupted benchmark goes on where it was.
"""

import argparse
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import smartview_jax as sv
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.simulation import paper_calibration, random_scene

from .real_sets import LENS, SHARED, held_out_px
from .records import append_record, read_records

STAGED, TRUSTED, WHITE, DEFAULT = "staged", "robot trusted", "white noise", "default"
SIMPLE = (STAGED, TRUSTED, WHITE)

ROBOTS = (0.0, 0.002, 0.02, 0.1, 1.0, 2.0, 5.0, 10.0, 20.0)
"""Standard deviations of reported positions, mm; orientations have a fifth of it in degrees."""

MAX_DEGREES = 2.0
EXACT = 0.002
"""Standard deviation up to which a robot counts as exact, mm."""

SEEDS = {8: 20, 20: 20, 60: 10, 120: 10, 2000: 2}
"""Number of seeds by number of views."""

MAX_PX_RATIO, MAX_MM_RATIO, MAX_EXACT_RATIO = 1.05, 1.15, 1.1
"""Largest ratios of the default to the best simple fit; for exact robots to the one that trusts."""

ROUNDING = (1e-3, 1e-3)
"""Differences of px and mm that are no matter."""

REAL, REAL_BOUND = "ur5e_kinect_78", 9.4
"""A real weak robot, and the held-out px that the default keeps below."""

PIXEL_NOISE, UNSEEN_VIEWS = 0.15, 40

Errors = dict[str, tuple[float, float] | None]
"""Px and mm of every fit; None where it raised an error."""


class Cell(NamedTuple):
    """A cell of the grid: a robot (mm), a number of views, and whether the camera is known."""

    millimetres: float
    views: int
    known_camera: bool

    @property
    def degrees(self) -> float:
        """The standard deviation of reported orientations."""
        return min(0.2 * self.millimetres, MAX_DEGREES)

    def __str__(self) -> str:
        camera = "known" if self.known_camera else "unknown"
        return f"{self.millimetres:g} mm, {self.degrees:g} deg, {self.views} views, camera {camera}"


def run(
    smoke: bool = False,
    results: Path | None = None,
    seeds: int | None = None,
    views: Collection[int] = tuple(SEEDS),
) -> bool:
    """Print a row for each cell; True where the default keeps within its bounds in all."""
    if smoke:
        return _row(Cell(2.0, 20, False), 1, {}, None, loose=True)
    done = _read(results)
    print(f"{'':46}" + "".join(f"{name:>22}" for name in (*SIMPLE, DEFAULT)) + "   of best")
    kept = []
    for count in views:
        # Every number of views has programs of its own, which a process cannot hold all.
        jax.clear_caches()
        for known_camera in (False, True):
            for millimetres in ROBOTS:
                cell = Cell(millimetres, count, known_camera)
                kept.append(_row(cell, seeds or SEEDS[count], done, results))
    if set(views) == set(SEEDS):
        kept.append(_real_row())
    return all(kept)


def _row(
    cell: Cell,
    seeds: int,
    done: dict[str, Errors],
    results: Path | None,
    loose: bool = False,
) -> bool:
    """Print a row; return whether the default keeps within its bounds."""
    runs = list(_errors_by_seed(cell, seeds, done, results))
    failed = {fit: sum(one[fit] is None for one in runs) for fit in (*SIMPLE, DEFAULT)}
    rms = {
        fit: np.sqrt(np.mean(np.square([one[fit] or (np.inf, np.inf) for one in runs]), axis=0))
        for fit in (*SIMPLE, DEFAULT)
    }
    exact = cell.millimetres <= EXACT
    best = rms[TRUSTED] if exact else np.min([rms[fit] for fit in SIMPLE], axis=0)
    limits = (MAX_EXACT_RATIO,) * 2 if exact else (MAX_PX_RATIO, MAX_MM_RATIO)
    limits = (2.0, 2.0) if loose else limits
    good = not failed[DEFAULT] and all(
        error <= limit * least + rounding
        for error, least, limit, rounding in zip(rms[DEFAULT], best, limits, ROUNDING, strict=True)
    )
    cells = "".join(
        f"{f'{px:.3g} px, {mm:.3g} mm' + (f' ({failed[fit]}!)' if failed[fit] else ''):>22}"
        for fit, (px, mm) in rms.items()
    )
    ratios = rms[DEFAULT] / np.maximum(best, 1e-12)
    text = f"{ratios[0]:.2f} px, {ratios[1]:.2f} mm{'' if good else '  OUT OF BOUND'}"
    print(f"{cell!s:46}{cells}   {text}", flush=True)
    return good


def _errors_by_seed(
    cell: Cell, seeds: int, done: dict[str, Errors], results: Path | None
) -> Iterator[Errors]:
    """Yield the errors of every seed; those that are not known yet are computed and written."""
    for seed in range(seeds):
        key = f"{cell}, seed {seed}"
        if key not in done:
            done[key] = _errors(cell, seed)
            append_record(results, {"run": key, "errors": done[key]})
        yield done[key]


def _read(results: Path | None) -> dict[str, Errors]:
    """Return the errors of the runs that a file holds."""
    return {record["run"]: record["errors"] for record in read_records(results)}


def _errors(cell: Cell, seed: int) -> Errors:
    """Return the errors of all fits to one simulated data set."""
    scene = random_scene(
        seed,
        cell.views,
        points=_board(),
        pixel_noise=PIXEL_NOISE,
        translation_noise=1e-3 * cell.millimetres,
        rotation_noise=float(np.deg2rad(cell.degrees)),
    )
    data, truth = scene.data, paper_calibration()
    unseen = random_scene(10_000 + seed, UNSEEN_VIEWS, points=_board(), pixel_noise=0.0).data
    camera = truth.camera if cell.known_camera else None
    fixed = ("camera",) if cell.known_camera else ()
    try:
        staged = sv.fit_staged(data, "radial", camera=camera).calibration
    except ValueError:
        return dict.fromkeys((*SIMPLE, DEFAULT))

    def joint(**options: Any) -> Callable[[], sv.Calibration]:
        return lambda: sv.fit_joint(data, staged, fixed=fixed, **options).calibration

    fits: dict[str, Callable[[], sv.Calibration]] = {
        STAGED: lambda: staged,
        TRUSTED: joint(noise="trusted"),
        WHITE: joint(field=None),
        DEFAULT: joint(),
    }
    return {name: _error(fit, unseen, truth) for name, fit in fits.items()}


def _error(
    fit: Callable[[], sv.Calibration], unseen: sv.Dataset, truth: sv.Calibration
) -> tuple[float, float] | None:
    """Return RMS px on unseen views and the error of the hand-eye translation, mm."""
    try:
        calibration = fit()
    except ValueError:
        return None
    errors = reprojection_errors(calibration, unseen)
    px = float("inf") if errors.unpredicted_count else errors.rms
    difference = calibration.camera_from_tool.translation() - truth.camera_from_tool.translation()
    return px, 1e3 * float(np.linalg.norm(np.asarray(difference)))


def _board() -> np.ndarray:
    """Return the 20 points of a board, m."""
    row, column = np.indices((4, 5)).reshape(2, -1)
    return np.stack([0.009 * column, 0.010 * row, np.zeros(20)], axis=1)


def _real_row() -> bool:
    """Print the held-out error of the real weak robot; return whether it keeps its bound."""
    folder = SHARED / REAL
    if not folder.is_dir():
        print("skipped: the data sets are not next to this checkout (shared/data)")
        return True
    data = sv.io.import_correspondences(
        folder / "poses.csv", folder / "corners.csv", image_size=(1280, 720)
    )
    px = held_out_px(data, lambda part: sv.fit_joint(part, sv.fit_staged(part, LENS).calibration))
    good = px <= REAL_BOUND
    print(f"{REAL}: held out {px:.3f} px{'' if good else '  OUT OF BOUND'}", flush=True)
    return good


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, help="of every cell; by default as in SEEDS")
    parser.add_argument("--views", type=int, nargs="*", default=tuple(SEEDS))
    parser.add_argument("--results", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    kept = run(results=arguments.results, seeds=arguments.seeds, views=arguments.views)
    sys.exit(0 if kept else 1)
