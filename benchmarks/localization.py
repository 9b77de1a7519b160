"""Known objects found and judged in rendered scenes: recall, false accepts, accuracy, time.

Five polyhedra of 50 to 70 mm, two of them symmetric, before an arm whose joints, links, mount and
lens err: alone, among clutter, with some 30 % of their edges hidden, one to eight in a bin, scenes
of another object, and empty ones. In each, what is there is looked for together with a model of
what is not. A pose is right within 3 degrees and 5 mm, up to symmetry. In further scenes there are
but solids that are like the one that is looked for in all but one or two of their sizes.

The scenes are run by several processes, each with cells of its own, and every record is a line of a
JSON file, so that an interrupted run goes on where it was.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from smartview_jax.localization import localize

from .grasping import calibrated
from .localization_cells import KINDS, cell_scene, true_calibration, workspace_of
from .localization_other_kinds import print_other_kinds
from .localization_pictures import print_real_pictures
from .localization_renderers import print_renderers
from .localization_scenes import CELL_ROWS, camera, solids
from .localization_spoilt import print_spoilt_pictures
from .localization_tables import SceneSeconds, print_seconds, print_tables
from .localization_trials import trial
from .records import append_record, read_records

RESULTS = Path(__file__).parents[1] / "build" / "localization" / "records.jsonl"
"""Where the records are, unless stated."""

SCENES = {
    "single": 80, "occluded": 60, "clutter": 40, "bin": 80, "wrong": 30, "empty": 20, "similar": 60,
}  # fmt: skip
"""Number of scenes of each kind."""

SMOKE_SCENES = {"single": 1, "bin": 1, "empty": 1, "similar": 1}
"""The same of a smoke run, all in one cell. Its other pictures have the size of the cell's, so that
all share compiled programs, which take most of its time."""

FIRST_SEED = 20_000
"""Seed of the first scene of each kind; nothing was tuned on seeds from here on."""

SMOKE_SEED = FIRST_SEED + 3
"""Seed of the scenes of a smoke run. Two views leave none of them open: no third views are taken
(`localization_trials.VIEWED_EVERY`), for which all programs would be compiled again."""

CELLS, FIRST_CELL = 4, 500
"""Number of cells, each with a calibration of its own, and the seed of the first one."""

TIMED = 10
"""Number of scenes that are timed by one process alone."""


def jobs(scenes: dict[str, int], first_seed: int = FIRST_SEED) -> list[tuple[str, int, int]]:
    """Return kind, seed and cell of every scene, the kinds mixed, so that a part tells of all."""
    listed = [
        ((k + 0.5) / count, kind, first_seed + k, FIRST_CELL + k % CELLS)
        for kind, count in scenes.items()
        for k in range(count)
    ]
    return [one[1:] for one in sorted(listed)]


def done(path: Path) -> dict[tuple[str, int], dict]:
    """Return the records of a file by kind and seed; a line that was cut off is left out."""
    return {(record["kind"], record["seed"]): record for record in read_records(path)}


def work(
    path: Path, worker: int, workers: int, scenes: dict[str, int], first_seed: int = FIRST_SEED
) -> None:
    """Run the scenes of one process, cell after cell, and append their records."""
    finished, rigs = done(path), {}
    for kind, seed, cell in jobs(scenes, first_seed):
        if cell % workers != worker or (kind, seed) in finished:
            continue
        if cell not in rigs:
            rigs[cell] = calibrated(cell)
        append_record(path, {"cell": cell} | trial(rigs[cell], kind, seed))


def _run_workers(path: Path, workers: int, scenes: dict[str, int]) -> None:
    """Run all scenes in several processes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "benchmarks.localization", "--results", str(path)]
    command += ["--workers", str(workers), "--scenes", json.dumps(scenes)]
    running = [subprocess.Popen([*command, "--worker", str(k)]) for k in range(workers)]
    failed = [one.wait() for one in running]
    if any(failed):
        raise RuntimeError(f"localization: worker {failed.index(max(failed))} failed")


def seconds_a_scene(count: int) -> list[SceneSeconds]:
    """Return warm times of `localize` on two new pictures of one object, in this process alone."""
    cell, taken = calibrated(FIRST_CELL)["joint"].cell, []
    detector = cv2.createLineSegmentDetector()
    for k in range(count + 2):
        scene = cell_scene(cell, KINDS[k % 3], FIRST_SEED - 100 + k)
        pictures = [view.picture for view in scene.views]
        poses = np.stack([view.base_from_tool for view in scene.views])
        name = scene.objects[0].name
        began = time.perf_counter()
        localize(
            pictures,
            poses,
            true_calibration(cell),
            solids()[name].exact_model(name),
            workspace=workspace_of(cell),
        )
        ended = time.perf_counter()
        for picture in pictures:
            detector.detect(picture)
        taken.append(SceneSeconds(ended - began, time.perf_counter() - ended))
    # The first ones load compiled programs.
    return taken[2:]


def run(smoke: bool = False, results: Path | None = None) -> bool:
    """Print the tables; True where every goal is met. `smoke` takes a few scenes of one process."""
    if smoke:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "records.jsonl"
            work(path, 0, 1, SMOKE_SCENES, SMOKE_SEED)
            good = print_tables(list(done(path).values()), smoke=True)
        good = print_spoilt_pictures(smoke=True) and good
        good = print_other_kinds({"apart25": 1}, camera(CELL_ROWS)) and good
        print_real_pictures(smoke=True)
        return good
    path = RESULTS if results is None else results
    _run_workers(path, min(2, os.cpu_count() or 1), SCENES)
    good = print_tables(list(done(path).values()))
    good = print_seconds(seconds_a_scene(TIMED)) and good
    good = print_spoilt_pictures() and good
    good = print_other_kinds() and good
    good = print_renderers() and good
    return print_real_pictures() and good


def main() -> int:
    parser = argparse.ArgumentParser(description="One process of the localisation benchmark.")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file of the records")
    parser.add_argument("--workers", type=int, default=2, help="number of processes")
    parser.add_argument("--worker", type=int, help="number of this one; without it, tables only")
    parser.add_argument("--timed", action="store_true", help="time some scenes, and nothing else")
    parser.add_argument("--scenes", type=json.loads, default=SCENES, help="number by kind, JSON")
    arguments = parser.parse_args()
    if arguments.timed:
        return 0 if print_seconds(seconds_a_scene(TIMED)) else 1
    if arguments.worker is None:
        return 0 if print_tables(list(done(arguments.results).values())) else 1
    work(arguments.results, arguments.worker, arguments.workers, arguments.scenes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
