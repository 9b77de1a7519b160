"""The public yardstick for poses without pixels: KinHEC's tracks, with its reference solvers.

KinHEC (package `kinhec`, extra `peers`) simulates streams of robot poses and tracked poses of 13
arms in eight tracks: noise, degenerate motion, clocks apart, outliers, a monocular tracker, errors
of the robot's kinematics, poses from pixels, and all mixed. Its eleven reference solvers and ours
get the same pairs by its protocol: key frames at least 5 degrees or 20 mm apart, at most 200, the
true clock offset. Printed are the median errors of X in every track (mm and degrees), how often a
solver gave an answer, and the median time of an answer; ours is `fit_poses`, and Step 3 of the
paper (`A X = X B` by BFGS). The NEES of X is the squared error of the joint fit over its stated
covariance, 6 in the mean and 5.3 in the median where that is right. Where the clocks are apart,
`estimate_time_offset` is compared with KinHEC's cross-correlation of angular speeds.

    python -m benchmarks kinhec                       # the tier of 562 sequences, simulated first
    python -m benchmarks.kinhec --data FOLDER --most 20    # so many of each track
    python -m benchmarks.kinhec --data FOLDER --results FOLDER    # goes on where it was stopped
"""

import argparse
import collections
import importlib
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import smartview_jax as sv
from smartview_jax.dataset import PoseDataset
from smartview_jax.engine import step_names
from smartview_jax.files import write_atomically
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.hand_eye import solve_hand_eye
from smartview_jax.joint.robust_hand_eye import chain_errors
from smartview_jax.robots import Trajectory

from .transform_errors import squared_errors, stated_covariance, transform_errors

TIER, SMOKE_TIER, SMOKE_MOST = "small", "smoke", 1
MAX_RATIO = 1.1
"""Largest ratio of our error to the best solver's that counts as among the best: the ratio of a
track's median errors, and the median of its sequences' ratios."""

MAX_OFFSET, CLOCK_PAIRS = 0.5, 100
"""Largest offset between clocks that is searched, s, and number of pairs from which."""

JOINT, STAGED = "smartview joint", "smartview Step 3"


class Answer(NamedTuple):
    """The errors of X by one solver of one sequence, and its time; NaN without an answer.

    Attributes:
        millimetres, degrees: errors of X.
        seconds: time of the answer.
        nees: squared error over the stated covariance; NaN without one, or with directions that
            nothing determines.
    """

    millimetres: float
    degrees: float
    seconds: float
    nees: float = np.nan


class Solution(NamedTuple):
    """X by a solver, and its NEES if it states a covariance."""

    X: np.ndarray
    nees: float = np.nan


def run(
    smoke: bool = False,
    data: Path | None = None,
    most: int | None = None,
    results: Path | None = None,
) -> bool:
    """Print the errors by track and solver; True where ours is among the best of every track.

    Args:
        smoke: whether a few sequences tell that it runs.
        data: folder of `kinhec generate`; by default they are simulated first.
        most: number of sequences of each track; all by default.
        results: folder of one version's answers, a file for each sequence. A run that was stopped
            goes on with the sequences that have none.
    """
    if importlib.util.find_spec("kinhec") is None:
        print("kinhec is not installed: pip install 'smartview-jax[peers]'")
        return True
    with tempfile.TemporaryDirectory() as folder:
        if data is None:
            data = Path(folder) / "kinhec"
            words = ["generate", "--tier", SMOKE_TIER if smoke else TIER, "--out", str(data)]
            subprocess.run([sys.executable, "-m", "kinhec", *words], check=True)
        tracks = _answers(data, SMOKE_MOST if smoke else most, results)
        clocks = _clock_errors(data, SMOKE_MOST if smoke else most)
    good = [_print_track(track, answers) for track, answers in sorted(tracks.items())]
    good.append(_print_clocks(clocks))
    return smoke or all(good)


class ClockError(NamedTuple):
    """The errors of one sequence's clock offset by us and by KinHEC, ms, and our 95 % interval."""

    ours: float
    half_width: float
    correlation: float


def _clock_errors(data: Path, most: int | None) -> list[ClockError]:
    """Return the errors of the clock offset in every sequence whose clocks are apart."""
    return [
        _clock_error(sequence) for _, sequence in _sequences(data, most) if not sequence.synchronous
    ]


def _clock_error(sequence: Any) -> ClockError:
    """Return the errors of one sequence's clock offset; ours from at most `CLOCK_PAIRS` pairs."""
    solvers: Any = importlib.import_module("kinhec.solvers")
    robot, tracker = sequence.robot, sequence.camera
    # KinHEC adds its offset to the robot's time, ours is added to the tracker's.
    truth = -1e3 * sequence.time_offset
    found, _ = solvers.estimate_time_offset(
        robot.t, robot.T_base_ee_meas, tracker.t, tracker.T_cam_target_meas
    )
    log = Trajectory.of(np.asarray(robot.t), np.asarray(robot.T_base_ee_meas))
    times, seen = np.asarray(tracker.t), np.asarray(tracker.T_cam_target_meas)
    inside = (times > log.times[0] + MAX_OFFSET) & (times < log.times[-1] - MAX_OFFSET)
    usable = np.flatnonzero(np.isfinite(seen).all(axis=(1, 2)) & inside)
    chosen = usable[np.unique(np.linspace(0, len(usable) - 1, CLOCK_PAIRS).astype(int))]
    mount = "eye_in_hand" if sequence.eye_in_hand else "eye_to_hand"
    pairs = PoseDataset.from_poses(log.at(times[chosen]), seen[chosen], mount)
    try:
        ours = sv.estimate_time_offset(pairs, log, times[chosen], max_offset=MAX_OFFSET)
    except ValueError:
        return ClockError(np.nan, np.nan, abs(-1e3 * found - truth))
    return ClockError(abs(1e3 * ours.seconds - truth), 1.96e3 * ours.std, abs(-1e3 * found - truth))


def _print_clocks(errors: list[ClockError]) -> bool:
    """Print the errors of the clock offset; return whether ours is better in the median."""
    if not errors:
        return True
    ours, half_width, correlation = np.array(errors).T
    given = np.isfinite(ours)
    medians = np.median(ours[given]), np.median(correlation)
    print(
        f"\nclocks apart: {len(errors)} sequences, median error\n"
        f"  {'smartview':22}{medians[0]:10.2f} ms, in the 95 % interval "
        f"{np.mean(ours[given] < half_width[given]):.0%}, given in {given.sum()}\n"
        f"  {'cross-correlation':22}{medians[1]:10.2f} ms"
    )
    return bool(given.all() and medians[0] <= medians[1])


def _answers(
    data: Path, most: int | None, results: Path | None
) -> dict[str, dict[str, list[Answer]]]:
    """Return the answers of all solvers by track, so many sequences of each."""
    tracks: dict[str, dict[str, list[Answer]]] = collections.defaultdict(
        lambda: collections.defaultdict(list)
    )
    for track, sequence in _sequences(data, most):
        for solver, answer in _kept_or_solved(sequence, results).items():
            tracks[track][solver].append(answer)
    return tracks


def _kept_or_solved(sequence: Any, results: Path | None) -> dict[str, Answer]:
    """Return the answers to a sequence, from its file if an earlier run has written it."""
    if results is None:
        return _solved(sequence)
    path = results / f"{sequence.manifest['sequence_id']}.json"
    if path.exists():
        return {name: Answer(*row) for name, row in json.loads(path.read_text()).items()}
    answers = _solved(sequence)
    write_atomically(path, json.dumps(answers))
    return answers


def _sequences(data: Path, most: int | None) -> Iterator[tuple[str, Any]]:
    """Return the sequences with their tracks, evenly spread over each."""
    # By its name as a text: a module of the same name stands here.
    kinhec: Any = importlib.import_module("kinhec")
    manifest = kinhec.load_manifest(data)
    for track, rows in manifest.groupby("track"):
        ids = list(rows.sequence_id)
        step = max(1, len(ids) // most) if most else 1
        for name in ids[::step][:most]:
            yield str(track), kinhec.load_sequence(data, name, manifest)


def _solved(sequence: Any) -> dict[str, Answer]:
    """Return the answers of all solvers to one sequence."""
    benchmark: Any = importlib.import_module("kinhec.benchmark")
    pairs = benchmark._keyframe_data(
        sequence, None if sequence.synchronous else sequence.time_offset
    )
    solvers: dict[str, Callable[[], Solution]] = {
        name: lambda solve=solve: Solution(solve(pairs, np.random.default_rng(0))["X"])
        for name, solve in benchmark.SOLVERS.items()
    }
    solvers[JOINT] = lambda: _joint(sequence, pairs)
    solvers[STAGED] = lambda: Solution(_staged(pairs))
    return {name: _timed(solve, sequence.X) for name, solve in solvers.items()}


def _timed(solve: Callable[[], Solution], truth: np.ndarray) -> Answer:
    """Return a solver's errors and time."""
    begun = time.perf_counter()
    try:
        found, nees = solve()
    except Exception:  # a solver that fails is a result of the benchmark
        return Answer(np.nan, np.nan, np.nan)
    seconds = time.perf_counter() - begun
    distance, angle = chain_errors(np.asarray(found)[None], truth[None])[0]
    return Answer(1e3 * float(distance), float(np.rad2deg(angle)), seconds, nees)


def _joint(sequence: Any, pairs: Any) -> Solution:
    """Return X by the joint fit: in the hand, or the pose of a marker on it."""
    flange, seen = pairs[0], pairs[1]
    # KinHEC has target_from_camera for a camera on the hand, and A X = Y B for both.
    in_hand = bool(sequence.eye_in_hand)
    measured = np.linalg.inv(seen) if in_hand else seen
    data = PoseDataset.from_poses(flange, measured, "eye_in_hand" if in_hand else "eye_to_hand")
    fit = _fit(data, str(sequence.manifest["track"]) == "monocular")
    name = "camera_from_tool" if in_hand else "tool_from_world"
    found = host_matrices(getattr(fit.calibration, name))
    X, truth = (np.linalg.inv(x) if in_hand else x for x in (found, np.asarray(sequence.X)))
    # What nothing determines is held, or has an infinite standard deviation.
    if not all(np.isfinite(fit.std.get(path, np.inf)) for path in step_names(name)):
        return Solution(X)
    errors = transform_errors(found, truth)
    return Solution(X, float(squared_errors(errors, stated_covariance(fit, name))))


def _fit(data: PoseDataset, scale: bool) -> sv.JointFit:
    """Return the joint fit, with an unknown unit where a refusal asks for it."""
    try:
        return sv.fit_poses(data, scale=scale)
    except ValueError as error:
        if scale or "scale=True" not in str(error):
            raise
    return sv.fit_poses(data, scale=True)


def _staged(pairs: Any) -> np.ndarray:
    """Return X by Step 3: A X = Y B is a fixed camera's chain, whatever the camera is on."""
    result = solve_hand_eye(as_se3(pairs[0]), as_se3(pairs[1]))
    return host_matrices(result.holder_from_world)


def _print_track(track: str, answers: dict[str, list[Answer]]) -> bool:
    """Print a track's table, best first; return whether ours is among the best and never failed."""
    count = len(answers[JOINT])
    print(f"\n{track}: {count} sequences, median errors")
    medians = {name: np.nanmedian(np.array(rows), axis=0) for name, rows in answers.items()}
    for name, (millimetres, degrees, seconds) in sorted(medians.items(), key=lambda m: m[1][0]):
        given = sum(np.isfinite(row.millimetres) for row in answers[name])
        print(
            f"  {name:22}{millimetres:10.3f} mm{degrees:10.4f} deg{given:6} of {count}"
            f"{1e3 * seconds:10.1f} ms"
        )
    best = min(median[0] for name, median in medians.items() if name != JOINT)
    errors = {name: np.array([row.millimetres for row in rows]) for name, rows in answers.items()}
    ours = errors.pop(JOINT)
    best_of_each = np.nanmin(list(errors.values()), axis=0)
    ratio = float(np.nanmedian(ours / best_of_each))
    print(f"  ours over the best of each sequence, median: {ratio:.2f} (claim <= {MAX_RATIO})")
    nees = np.array([row.nees for row in answers[JOINT] if np.isfinite(row.nees)])
    if len(nees):
        print(
            f"  NEES of X in {len(nees)}: median {np.median(nees):.1f} (5.3 is right), mean "
            f"{np.mean(nees):.3g} (6)"
        )
    return bool(
        np.isfinite(ours).all() and medians[JOINT][0] <= MAX_RATIO * best and ratio <= MAX_RATIO
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="of `kinhec generate`")
    parser.add_argument("--most", type=int, metavar="N", help="sequences of each track")
    parser.add_argument("--results", type=Path, metavar="FOLDER", help="to go on after a stop")
    arguments = parser.parse_args()
    holds = run(data=arguments.data, most=arguments.most, results=arguments.results)
    sys.exit(0 if holds else 1)
