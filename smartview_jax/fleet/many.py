"""Calibrate many data sets, such as a fleet of robots, in worker processes."""

import functools
import os
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import Executor
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from ..calibration_pipeline import CalibrationFit, calibrate
from ..dataset import Dataset
from ..io import load_dataset
from ..joint import JointOptions, PoseFit, TrackedPoses, fit_poses
from .execution import outcomes

ManyData = Dataset | TrackedPoses | str | os.PathLike[str]
"""One of many data sets: with pictures, with tracked poses, or the folder of either."""


class ManyOutcome(NamedTuple):
    """The calibration of one of many data sets, or the error that prevented it.

    Attributes:
        number: position of the data set in the order in which they were given, from zero.
        name: the folder's name, or else `data set <index>`.
        fit: the calibration, of tracked poses a `PoseFit`; None after an error.
        error: the error; None if there is a calibration.
    """

    number: int
    name: str
    fit: CalibrationFit | PoseFit | None
    error: Exception | None

    def __str__(self) -> str:
        return f"{self.name}: {self.fit if self.error is None else self.error}"


def calibrate_many(
    datasets: Iterable[ManyData],
    executor: Executor | int | None = None,
    *,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Iterator[ManyOutcome]:
    """Calibrate many data sets in parallel; yield each calibration or error as soon as it is known.

    No data set is lost to the failure of another one or of a worker. If a worker process is killed,
    its work is done again in a new one; only a data set that kills its worker repeatedly becomes an
    error. Few data sets and results are in memory at a time, so that `datasets` may be a generator
    of any number. Programs are compiled by the first data set; workers read them from the folder
    described in `runtime.compilation_cache`. For 500 data sets or more, or an unknown number,
    worker processes of this machine optimise the programs: they compile longer and run faster, and
    results differ by rounding.

    A script that uses processes needs `if __name__ == "__main__":` before the call, because each
    process imports the script.

    Args:
        datasets: data sets of any shapes, or folders, which the workers load. Those with tracked
            poses, a `PoseDataset` or `PoseSamples` or the folder of one, are fitted by `fit_poses`.
        executor: any executor of `concurrent.futures`, such as the one of a Dask client; a
            number of processes of this machine; or None for as many as there are processors.
        progress: called with a line of text after each data set.
        options: options of `calibrate`, or of `fit_poses` for tracked poses, the same for all.

    Raises:
        TypeError: an unknown option, a single data set, or an executor of another kind.
        ValueError: a number of processes below one.
        RuntimeError: worker processes cannot be started.

    For example:

        >>> from concurrent.futures import ThreadPoolExecutor
        >>> robots = [data, data.select([0])]  # one view is not enough
        >>> with ThreadPoolExecutor(1) as executor:
        ...     outcomes = list(sv.calibrate_many(robots, executor, lens="radial", noise=noise))
        >>> for outcome in sorted(outcomes, key=lambda outcome: outcome.number):
        ...     print(outcome.name, "-", type(outcome.fit).__name__, type(outcome.error).__name__)
        data set 0 - CalibrationFit NoneType
        data set 1 - NoneType ValueError
    """
    known = {*_options_of(calibrate), *_options_of(fit_poses), *JointOptions.__annotations__}
    for name in options.keys() - (known - {"joint_options"}):
        raise TypeError(f"calibrate_many: {name!r} is no option of calibrate or fit_poses")
    if isinstance(datasets, Dataset | TrackedPoses | str | os.PathLike):
        raise TypeError(
            "datasets: expected a list of data sets or folders, found a single "
            f"{type(datasets).__name__}"
        )
    if not isinstance(executor, Executor | int | None):
        raise TypeError(
            f"executor: expected a concurrent.futures.Executor or a number of processes, found "
            f"{type(executor).__name__}"
        )
    if isinstance(executor, int) and executor < 1:
        raise ValueError(f"executor: expected at least one process, found {executor}")
    return _calibrations(datasets, executor, progress or (lambda _: None), options)


def _calibrations(
    datasets: Iterable[ManyData],
    executor: Executor | int | None,
    progress: Callable[[str], None],
    options: dict[str, Any],
) -> Iterator[ManyOutcome]:
    """Yield the calibrations, after the arguments were checked."""
    dataset_count = len(datasets) if isinstance(datasets, Sized) else None
    total = "" if dataset_count is None else f" of {dataset_count}"
    # Only the names of data sets in work are kept.
    names: dict[int, str] = {}

    def named() -> Iterator[ManyData]:
        for index, dataset in enumerate(datasets):
            names[index] = _name_of(index, dataset)
            yield dataset

    job = functools.partial(_calibrate_one, options=options)
    for count, outcome in enumerate(outcomes(job, named(), executor, dataset_count), 1):
        name = names.pop(outcome.number)
        progress(f"{name}: {'failed' if outcome.error else 'calibrated'}, {count}{total}")
        yield ManyOutcome(outcome.number, name, outcome.result, outcome.error)


def _name_of(index: int, dataset: ManyData) -> str:
    is_folder = isinstance(dataset, str | os.PathLike)
    return Path(dataset).resolve().name if is_folder else f"data set {index}"


def _calibrate_one(dataset: ManyData, options: dict[str, Any]) -> CalibrationFit | PoseFit:
    """Load a data set if it is a folder, and calibrate it."""
    data = load_dataset(dataset) if isinstance(dataset, str | os.PathLike) else dataset
    if not isinstance(data, TrackedPoses):
        return calibrate(data, **options)
    for name in options.keys() - _options_of(fit_poses):
        raise TypeError(f"{name!r} is no option of fit_poses, which takes tracked poses")
    return fit_poses(data, **options)


def _options_of(fit: Callable[..., Any]) -> set[str]:
    """Return the names of a function's arguments without the first, which are the data."""
    return {*list(signature(fit).parameters)[1:]}
