"""Many robots of one type: what each gains from the others, and how fast and large it gets.

Simulated six-axis arms with joint readings, whose zeros are wrong by 0.1 degrees and whose links by
0.3 mm and 0.03 degrees, see a board in three views each; one of 25 is of another type, with errors
five times as large. Each is calibrated by itself, `sv.fleet_prior` learns from all, and each is
calibrated again with that prior. Printed are the hand-eye errors of the type's robots (RMS and
median, mm), in how many the 95 % interval of a coordinate holds the truth, and which robots are
named as of another type.

With `--common 0.5`, half of the variance of the type's errors is common to all its robots, as where
the type's drawings are wrong; the prior then has their mean. Without, the robots have no errors in
common.

Then `sv.calibrate_many` runs on one and on more processes: sets a minute, and the memory of all
processes as the sets go by.

    python -m benchmarks fleet
    python -m benchmarks.fleet --robots 200 --sets 300 --processes 1 2
    python -m benchmarks.fleet --robots 120 --sets 0 --common 0.5
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import smartview_jax as sv
from smartview_jax.fleet import FleetPrior, outcomes
from smartview_jax.robot_errors import RobotError, RobotPrior
from smartview_jax.robots import six_axes
from smartview_jax.simulation import random_kinematic_errors, six_axis_scene

ERRORS = {
    "joint_offset": float(np.deg2rad(0.1)),
    "link_length": 3e-4,
    "link_twist": float(np.deg2rad(0.03)),
}
OTHER_TYPE_EVERY, OTHER_TYPE_SCALE = 25, 5.0
VIEWS = 3

COMMON_SEED = 20
"""Seed of the errors that the robots of the type have in common."""

MAX_ERROR_RATIO, COVERAGE = 0.6, (0.93, 0.97)
"""Claims: median hand-eye error over the independent fits', and coverage of 95 % intervals."""

MIN_SETS_PER_MINUTE, MAX_GROWTH = 1000.0, 1.1
"""Claims: sets a minute on two processors, and memory at the end to memory after a fifth."""


class Robot(NamedTuple):
    """One robot's fit: errors and intervals of the hand-eye translation, m.

    `fit` is the fit itself where it is wanted.
    """

    error: np.ndarray
    half_width: np.ndarray
    fit: sv.JointFit | None


def run(
    smoke: bool = False,
    robots: int = 1000,
    sets: int = 5000,
    processes: Sequence[int] = (1, 2),
    common: float = 0.0,
) -> bool:
    """Print gain, time and memory; True where all claims hold.

    `common` is the share of the errors' variance that is common to the robots of the type.
    """
    if smoke:
        gains = _gain(8, ThreadPoolExecutor(1), 0.0, loose=True)
        return gains & _speed(4, (), ThreadPoolExecutor(1))
    gains = _gain(robots, max(processes), common)
    return gains & _speed(sets, processes, None) if sets else gains


def _gain(robots: int, executor: Executor | int, common: float, loose: bool = False) -> bool:
    """Print what the prior of the fleet gains; True where the claims hold."""
    alone = dict(_calibrated(range(robots), None, executor, common))
    numbers = sorted(alone)
    failed = robots - len(numbers)
    begun = time.perf_counter()
    prior = sv.fleet_prior(_fit_of(alone[k]) for k in numbers)
    seconds = time.perf_counter() - begun
    with_prior = dict(_calibrated(numbers, prior, executor, common))
    others = {k for k in numbers if _is_of_other_type(k)}
    _print_prior(prior, seconds, common)
    named = {numbers[k] for k in prior.outsiders}
    print(
        f"of another type: {len(others)}, named {len(named & others)}; "
        f"named of the type itself: {len(named - others)} of {len(numbers) - len(others)}"
    )
    of_type = [k for k in numbers if k not in others and k in with_prior]
    print(f"\n{len(of_type)} robots of the type, {VIEWS} views each ({failed} failed)")
    figures = {}
    for name, found in (("each by itself", alone), ("with the prior", with_prior)):
        errors = np.array([found[k].error for k in of_type])
        covered = np.abs(errors) < [found[k].half_width for k in of_type]
        lengths = 1e3 * np.linalg.norm(errors, axis=1)
        rms = float(np.sqrt(np.mean(lengths**2)))
        figures[name] = rms, float(np.median(lengths)), float(covered.mean())
        print(
            f"  {name:16} RMS {rms:6.3f} mm, median {figures[name][1]:6.3f} mm, "
            f"in the 95 % interval {covered.mean():.1%}"
        )
    (rms, median, _), (prior_rms, prior_median, coverage) = figures.values()
    ratio = prior_median / median
    print(f"  ratio: RMS {prior_rms / rms:.2f}, median {ratio:.2f} (claim <= {MAX_ERROR_RATIO})")
    kept = ratio <= MAX_ERROR_RATIO and COVERAGE[0] <= coverage <= COVERAGE[1]
    return loose or (kept and not failed)


def _calibrated(
    numbers: Sequence[int], prior: RobotPrior | None, executor: Executor | int, common: float
) -> Iterator[tuple[int, Robot]]:
    """Yield number and fit of every robot that could be calibrated."""
    for outcome in outcomes(partial(_robot, prior=prior, common=common), numbers, executor):
        number = numbers[outcome.number]
        if outcome.error is None:
            yield number, outcome.result
        else:
            print(f"robot {number}: {outcome.error}", flush=True)


def _is_of_other_type(number: int) -> bool:
    return number % OTHER_TYPE_EVERY == OTHER_TYPE_EVERY // 5


def _scene(number: int, common: float = 0.0) -> Any:
    """Return the views of one robot; `common` is the type's share of the errors' variance."""
    of_type, error = not _is_of_other_type(number), None
    scale = 1.0 if of_type else OTHER_TYPE_SCALE
    if common and of_type:
        shared, own = (
            random_kinematic_errors(six_axes(), np.random.default_rng(seed), 1.0, ERRORS)
            for seed in ((COMMON_SEED, 0), (COMMON_SEED, 1, number))
        )
        whole = common**0.5 * shared.coefficients + (1.0 - common) ** 0.5 * own.coefficients
        error = RobotError(own.field, whole)
    scene = six_axis_scene(
        number, VIEWS, held_out_views=1, error_scale=scale, error_sigma=ERRORS, arm_error=error
    )
    return scene.with_joint_readings


def _robot(number: int, prior: RobotPrior | None, common: float) -> Robot:
    """Simulate and calibrate one robot."""
    scene = _scene(number, common)
    fit = sv.calibrate(scene.data, robot_prior=prior)
    poses = fit.calibration.camera_from_tool, scene.calibration.camera_from_tool
    found, truth = (np.asarray(pose.translation()) for pose in poses)
    names = [f"camera_from_tool.translation.{axis}" for axis in "xyz"]
    half_width = np.array([fit.confidence_half_width(name) for name in names])
    return Robot(found - truth, half_width, fit.joint if prior is None else None)


def _fit_of(robot: Robot) -> sv.JointFit:
    assert robot.fit is not None
    return robot.fit


def _print_prior(prior: FleetPrior, seconds: float, common: float) -> None:
    """Print the prior next to the simulated sizes of what robots deviate from their type."""
    print(f"prior of the type in {seconds:.0f} s: model {prior.model}")
    for name, size in ERRORS.items():
        std, truth = prior.geometric_std_of(name), (1.0 - common) ** 0.5 * size
        print(f"  {name:13} {prior.group_medians[name]:.2e} (simulated {truth:.2e}), x/ {std:.2f}")


def _speed(sets: int, processes: Sequence[int], executor: Executor | None) -> bool:
    """Print sets a minute by processes, and memory over the sets; True where the claims hold."""
    data = [_scene(k).data for k in range(min(sets, 20))]
    holds = True
    print(f"\n{VIEWS} views of {data[0].visible.shape[1]} points a set, without detection")
    for count in processes or (None,):
        wanted = sets if count in (None, max(processes, default=0)) else max(sets // 10, len(data))
        begun, first, memory = time.perf_counter(), 0.0, []
        repeated = (data[k % len(data)] for k in range(wanted))
        for done, outcome in enumerate(sv.calibrate_many(repeated, executor or count), 1):
            if outcome.error is not None:
                raise outcome.error
            del outcome
            # The first ones read or compile their programs.
            if done == len(data):
                first = time.perf_counter()
            if done % max(wanted // 5, 1) == 0:
                memory.append(_megabytes())
        rate = 60.0 * (wanted - len(data)) / max(time.perf_counter() - first, 1e-9)
        listed = " ".join(f"{megabytes:.0f}" for megabytes in memory)
        rate = rate if wanted > len(data) else float("nan")
        print(
            f"  {count or 1} process{'es' if (count or 1) > 1 else ''}: {rate:.0f} sets a minute "
            f"after the first {len(data)} (those: {first - begun:.0f} s); memory after each fifth "
            f"of {wanted}: {listed} MB"
        )
        if count is not None and count == max(processes):
            holds = rate >= MIN_SETS_PER_MINUTE and memory[-1] <= MAX_GROWTH * memory[0]
    return holds


def _megabytes() -> float:
    """Return the memory of this process and its children, MB; zero where Linux does not say it."""
    here = str(os.getpid())
    total = 0
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in status.read_text().splitlines())
        except (OSError, ValueError):
            continue
        if here in (status.parent.name, fields["PPid"].strip()) and "VmRSS" in fields:
            total += int(fields["VmRSS"].split()[0])
    return total / 1024.0


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--sets", type=int, default=5000)
    parser.add_argument("--processes", type=int, nargs="*", default=(1, 2))
    parser.add_argument("--common", type=float, default=0.0)
    sys.exit(0 if run(**vars(parser.parse_args())) else 1)
