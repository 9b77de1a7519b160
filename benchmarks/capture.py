"""Live capture without a person in the simulated cell, by processes that are killed on the way.

Each cell is captured by a process that is killed (SIGKILL) after some views, and by another one
that goes on in the same folder to the wanted error. Counted are views that a process had announced
and that are not in the folder, rows without a picture and the reverse, and poses on the way at
which the gripper is below the height of the table. The true error is the displacement, by the error
of the hand-eye transform, of the point that the stated error is about.

The arm has 0.3 of the errors in `simulation.random_truth`, as one that its maker has calibrated,
and the pictures have half the size.

    python -m benchmarks capture --results build/capture.jsonl
    python -m benchmarks.capture --seeds 6 --jobs 1 --results build/capture.jsonl

With `--results` every cell is written to the file when it is done, and cells that it holds are not
captured again: an interrupted benchmark continues.
"""

import argparse
import dataclasses
import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from smartview_jax.capture import (
    CaptureOptions,
    CaptureSession,
    Reopened,
    SimulatedSources,
    capture_unattended,
)
from smartview_jax.dataset import MINIMUM_RELIABLE_VIEWS
from smartview_jax.geometry import host_matrices
from smartview_jax.io import GrowingDataset, load_dataset
from smartview_jax.simulation import CellTruth, SimulatedCell, random_truth

from .records import append_record, read_records

ERROR_SCALE = 0.3
"""Errors of the arm, as multiples of those in `random_truth`."""

GOAL, SMOKE_GOAL = 0.5, 5.0
"""The wanted error, mm."""

SEEDS = 24

TIMEOUT = 1800.0
"""Longest time of a process, s."""

JOBS = 2
"""Cells that are captured at the same time."""

CHILD = "import sys; from benchmarks.capture import child; child(*sys.argv[1:])"


class Captured(NamedTuple):
    """What came out of one cell.

    Attributes:
        reached: whether the run ended with the wanted error.
        views: number of views.
        stated, true: errors, mm.
        lowest: smallest height of the gripper above the table, m.
        lost: announced views that are not in the folder.
        halves: rows without a picture, and pictures without a row.
        seconds: time of both processes.
    """

    reached: bool
    views: int
    stated: float
    true: float
    lowest: float
    lost: int
    halves: int
    seconds: float


def truth_of(seed: int, divisor: int) -> CellTruth:
    """Return the true state of a cell whose pictures are smaller by a divisor."""
    truth = random_truth(seed, ERROR_SCALE)
    camera = truth.calibration.camera
    width, height = camera.image_size
    smaller = dataclasses.replace(
        camera,
        alpha_u=camera.alpha_u / divisor,
        alpha_v=camera.alpha_v / divisor,
        u0=camera.u0 / divisor,
        v0=camera.v0 / divisor,
        image_size=(width // divisor, height // divisor),
    )
    return dataclasses.replace(
        truth, calibration=dataclasses.replace(truth.calibration, camera=smaller)
    )


def child(folder: str, seed: str, divisor: str, goal: str) -> None:
    """Capture into a folder until the goal is reached, and print what happens."""
    truth = truth_of(int(seed), int(divisor))
    # The table's print costs most of the pictures' time, and is behind the board.
    cell = SimulatedCell(int(seed), truth=truth, clutter=False)
    sources = SimulatedSources(int(seed), cell)
    sources.write_description(Path(folder))
    drawing = sources.drawing
    options = CaptureOptions(
        goal=1e-3 * float(goal),
        start={
            "camera_from_tool": drawing.camera_from_tool,
            "base_from_world": drawing.base_from_world,
        },
        motion=sources.limits,
        first_fit=MINIMUM_RELIABLE_VIEWS,
    )
    camera, robot = Reopened(sources.camera), Reopened(sources.robot)

    def say(text: str) -> None:
        print(text, flush=True)

    with (
        GrowingDataset(folder) as data,
        CaptureSession(data, camera, robot, options, say) as session,
    ):
        outcome = capture_unattended(session)
        last = session.last_estimate
    true = float("nan")
    if last is not None and last.fit is not None:
        point = np.array([0.0, 0.0, last.distance, 1.0])
        tools = [
            np.linalg.inv(host_matrices(calibration.camera_from_tool)) @ point
            for calibration in (last.fit.calibration, truth.calibration)
        ]
        true = 1e3 * float(np.linalg.norm(tools[0] - tools[1]))
    say(
        f"result {int(outcome.is_reached)} {outcome.views} {1e3 * outcome.error} {true} "
        f"{sources.lowest}"
    )


def _process(arguments: list[str], kill_after: int | None) -> tuple[list[str], list[float]]:
    """Run a process, killed once it has announced some views; return announced views and result."""
    announced: list[str] = []
    result: list[float] = []
    words = [sys.executable, "-c", CHILD, *arguments]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("view "):
                announced.append(line.split()[1])
            elif line.startswith("result "):
                result = [float(word) for word in line.split()[1:]]
            if kill_after is not None and len(announced) == kill_after:
                os.kill(process.pid, signal.SIGKILL)
        process.wait(TIMEOUT)
    return announced, result


def captured(seed: int, divisor: int, goal: float) -> Captured:
    """Return what came out of one cell, whose first process was killed."""
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "data"
        arguments = [str(folder), str(seed), str(divisor), str(goal)]
        # Sometimes between the first views, sometimes while a fit runs.
        kill_after = 1 + int(np.random.default_rng((seed, 5)).integers(MINIMUM_RELIABLE_VIEWS + 2))
        first, _ = _process(arguments, kill_after)
        after_kill = set(load_dataset(folder, keep_detections=False).view_ids)
        second, result = _process(arguments, None)
        names = set(load_dataset(folder, keep_detections=False).view_ids)
        pictures = {path.stem for path in (folder / "images").iterdir()}
        lost = len({*first} - after_kill) + len({*first, *second} - names)
        if not result:
            result = [0.0, len(names), np.nan, np.nan, np.nan]
        reached, views, stated, true, lowest = result
        seconds, halves = time.monotonic() - begun, len(names ^ pictures)
        return Captured(bool(reached), int(views), stated, true, lowest, lost, halves, seconds)


def _kept(path: Path | None) -> dict[int, Captured]:
    """Return the cells that a file of results holds, by seed."""
    return {record.pop("seed"): Captured(**record) for record in read_records(path)}


def _cells(seeds: int, divisor: int, goal: float, jobs: int, path: Path | None) -> list[Captured]:
    """Capture the cells that the file does not hold; print and return all."""
    kept, cells = _kept(path), []

    def cell_of(seed: int) -> Captured:
        if seed not in kept:
            kept[seed] = captured(seed, divisor, goal)
            append_record(path, {"seed": seed, **kept[seed]._asdict()})
        return kept[seed]

    with ThreadPoolExecutor(jobs) as workers:
        for seed, cell in enumerate(workers.map(cell_of, range(seeds))):
            cells.append(cell)
            print(
                f"{seed:4}{cell.views:7}{cell.stated:11.2f}{cell.true:9.2f}{cell.lowest:10.3f}"
                f"{cell.lost + cell.halves:6}{cell.seconds:6.0f}"
                f"{'' if cell.reached else '  NOT REACHED'}",
                flush=True,
            )
    return cells


def run(
    smoke: bool = False,
    results: Path | None = None,
    seeds: int = SEEDS,
    jobs: int = JOBS,
) -> bool:
    """Print one line for each cell; True where all reached it and nothing was touched or lost."""
    seeds, divisor, goal, jobs = (1, 4, SMOKE_GOAL, 1) if smoke else (seeds, 2, GOAL, jobs)
    # A smoke test's cell is another one, with smaller pictures.
    results = None if smoke else results
    print(f"goal {goal:g} mm")
    headings = f"{'seed':>4}{'views':>7}{'stated mm':>11}{'true mm':>9}{'lowest m':>10}"
    print(f"{headings}{'lost':>6}{'s':>6}")
    cells = _cells(seeds, divisor, goal, jobs, results)
    reached = sum(cell.reached for cell in cells)
    collisions = sum(not cell.lowest > 0.0 for cell in cells)
    lost = sum(cell.lost + cell.halves for cell in cells)
    ratio = float(np.mean([(cell.true / cell.stated) ** 2 for cell in cells]))
    # In the worst case the error has one direction, and its square one degree of freedom.
    limit = float(chi2.ppf(0.995, len(cells)) / len(cells))
    views = [cell.views for cell in cells]
    print(
        f"{reached} of {len(cells)} reached the goal; {collisions} collisions; {lost} lost rows; "
        f"views {min(views)} to {max(views)}; mean square of true over stated error {ratio:.2f} "
        f"(1 is right, below {limit:.2f} is asked)"
    )
    return reached == len(cells) and not collisions and not lost and ratio < limit


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--jobs", type=int, default=JOBS, help="cells at the same time")
    parser.add_argument("--results", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    holds = run(results=arguments.results, seeds=arguments.seeds, jobs=arguments.jobs)
    sys.exit(0 if holds else 1)
