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
from ..joint import JointOptions
from .execution import outcomes


class ManyOutcome(NamedTuple):
    """The calibration of one of many data sets, or the error that prevented it.

    Attributes:
        number: position of the data set in the order in which they were given, from zero.
        name: the folder's name, or else `data set <index>`.
        fit: the calibration; None after an error.
        error: the error; None if there is a calibration.
    """

    number: int
    name: str
    fit: CalibrationFit | None
    error: Exception | None

    def __str__(self) -> str:
        return f"{self.name}: {self.fit if self.error is None else self.error}"


def calibrate_many(
    datasets: Iterable[Dataset | str | os.PathLike[str]],
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
        datasets: data sets of any shapes, or folders, which the workers load.
        executor: any executor of `concurrent.futures`, such as the one of a Dask client; a
            number of processes of this machine; or None for as many as there are processors.
        progress: called with a line of text after each data set.
        options: options of `calibrate`, the same for all.

    Raises:
        TypeError: an unknown option, or an executor of another kind.
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
    known = {*signature(calibrate).parameters, *JointOptions.__annotations__}
    for name in options.keys() - (known - {"data", "joint_options"}):
        raise TypeError(f"calibrate_many: {name!r} is no option of calibrate")
    if not isinstance(executor, Executor | int | None):
        raise TypeError(
            f"executor: expected a concurrent.futures.Executor or a number of processes, found "
            f"{type(executor).__name__}"
        )
    if isinstance(executor, int) and executor < 1:
        raise ValueError(f"executor: expected at least one process, found {executor}")
    return _calibrations(datasets, executor, progress or (lambda _: None), options)


def _calibrations(
    datasets: Iterable[Dataset | str | os.PathLike[str]],
    executor: Executor | int | None,
    progress: Callable[[str], None],
    options: dict[str, Any],
) -> Iterator[ManyOutcome]:
    """Yield the calibrations, after the arguments were checked."""
    dataset_count = len(datasets) if isinstance(datasets, Sized) else None
    total = "" if dataset_count is None else f" of {dataset_count}"
    # Only the names of data sets in work are kept.
    names: dict[int, str] = {}

    def named() -> Iterator[Dataset | str | os.PathLike[str]]:
        for index, dataset in enumerate(datasets):
            names[index] = _name_of(index, dataset)
            yield dataset

    job = functools.partial(_calibrate_one, options=options)
    for count, outcome in enumerate(outcomes(job, named(), executor, dataset_count), 1):
        name = names.pop(outcome.number)
        progress(f"{name}: {'failed' if outcome.error else 'calibrated'}, {count}{total}")
        yield ManyOutcome(outcome.number, name, outcome.result, outcome.error)


def _name_of(index: int, dataset: Dataset | str | os.PathLike[str]) -> str:
    return f"data set {index}" if isinstance(dataset, Dataset) else Path(dataset).resolve().name


def _calibrate_one(
    dataset: Dataset | str | os.PathLike[str], options: dict[str, Any]
) -> CalibrationFit:
    """Load a data set if it is a folder, and calibrate it."""
    data = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    return calibrate(data, **options)
