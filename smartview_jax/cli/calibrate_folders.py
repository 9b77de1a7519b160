"""Calibrate several data sets for `smartview calibrate`, in processes, and print a table of all."""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

import smartview_jax as sv

from ..files import refuse_unwritable
from .calibrate_folder import CalibrateSettings, loaded_folder
from .calibrate_pictures import PictureResult, calibrated_pictures
from .calibrate_poses import PoseResult, calibrated_poses
from .calibrate_result import run_name
from .documents import print_document
from .terminal import print_lines, progress_line

FAILED_CODE, NOT_CONVERGED_CODE = 2, 1
"""Exit codes if a folder could not be calibrated, and if a fit did not converge."""

MIN_NAME_WIDTH, MAX_NAME_WIDTH = 8, 18
"""Width of the column of names: in a terminal of 80 characters names are cut, but no number."""

_GAP = 2
"""Blanks between two columns."""


class FolderResult(NamedTuple):
    """The calibration of a folder, in figures that fit a row of a table.

    Attributes:
        views: number of views, or of pairs of poses, that were used.
        rms: RMS of the residuals, px, or of the distances of tracked poses, mm.
        unit: of `rms`: `"px"` or `"mm"`.
        held_out_rms: the same on views that the fit did not see; None if it was not computed.
        translation: translation of the hand-eye transform, mm.
        translation_std: length of the vector of its standard deviations, mm; None if it is held.
        document: everything that `--json` prints about the folder.
    """

    views: int
    rms: float
    unit: str
    held_out_rms: float | None
    translation: tuple[float, float, float]
    translation_std: float | None
    outcome: str
    converged: bool
    document: dict[str, Any]


def calibrate_folders(
    folders: Sequence[Path], out: Path, settings: CalibrateSettings, jobs: int | None, json: bool
) -> int:
    """Calibrate folders, write each calibration, print a table, and return the exit code."""
    names = [folder.stem if folder.is_file() else folder.resolve().name for folder in folders]
    for name, count in Counter(names).items():
        if count > 1:
            raise ValueError(
                f"{count} data sets are called {name}: their results would be written to the same "
                f"folder {out / name}; give them other names, or calibrate one at a time"
            )
    places = [out / name for name in names]
    for place in places:
        refuse_unwritable(place, "--out")
    if settings.mount is not None and not any(folder.is_file() for folder in folders):
        raise ValueError("--mount: expected a file of samples; a data-set folder states its mount")
    job = functools.partial(_calibrate_folder, settings=settings)
    outcomes: dict[int, sv.fleet.Outcome] = {}
    with progress_line() as progress, ExitStack() as stack:
        # One at a time needs no second process.
        executor = stack.enter_context(ThreadPoolExecutor(1)) if jobs == 1 else jobs
        for outcome in sv.fleet.outcomes(job, list(zip(folders, places, strict=True)), executor):
            outcomes[outcome.number] = outcome
            ended = "failed" if outcome.error else "calibrated"
            progress(f"{names[outcome.number]} {ended}: {len(outcomes)} of {len(folders)}")
    results = [outcomes[number] for number in range(len(folders))]
    if json:
        print_document("calibrate", {"data_sets": _documents(names, results)})
    else:
        _print_table(names, results, out)
    if any(outcome.error for outcome in results):
        return FAILED_CODE
    return 0 if all(outcome.result.converged for outcome in results) else NOT_CONVERGED_CODE


def _calibrate_folder(paths: tuple[Path, Path], settings: CalibrateSettings) -> FolderResult:
    """Calibrate one data set into its folder of results, and return what the table needs."""

    def silent(_: str) -> None:
        """Report nothing: the lines of several folders would be mixed."""

    dataset, out = paths
    if not dataset.is_file():
        settings = dataclasses.replace(settings, mount=None)
    result, run = fitted_folder(dataset, settings, silent), run_name()
    document = result.document(run, list(result.write(out, run, silent)))
    if isinstance(result, PoseResult):
        return _summary_of_poses(result, document)
    return _summary(result, document)


def fitted_folder(
    dataset: Path | None, settings: CalibrateSettings, progress: Callable[[str], None]
) -> PictureResult | PoseResult:
    """Load and fit the pictures or the tracked poses of one folder; None is the sample."""
    data, name = loaded_folder(dataset, settings, progress)
    if isinstance(data, sv.dataset.PoseDataset):
        return calibrated_poses(data, name, settings, progress)
    return calibrated_pictures(data, name, settings, progress)


def _summary_of_poses(result: PoseResult, document: dict[str, Any]) -> FolderResult:
    """Return the figures of a fit to tracked poses for a row of the table."""
    fit, held_out = result.fit, document["held_out_rms"]
    held_out_mm = None if held_out is None else held_out["mm"]
    errors = (int(fit.used_views.sum()), document["fitted_rms"]["mm"], "mm", held_out_mm)
    return _row(fit, errors, len(fit.warnings), document)


def _summary(result: PictureResult, document: dict[str, Any]) -> FolderResult:
    """Return the figures of a calibration for a row of the table."""
    # The staged fit comes first, then the joint fit, and last its chain without the correction.
    joint = document["errors"][1]
    held_out = None if joint["held_out"] is None else joint["held_out"]["rms_px"]
    left_out = {entry["view"] for entry in document["left_out_views"]}
    views = len(result.data.view_ids) - len(left_out)
    errors = (views, joint["fitted"]["rms_px"], "px", held_out)
    return _row(result.fit, errors, len(result.warnings), document)


def _row(
    fit: Any,
    errors: tuple[int, float, str, float | None],
    warnings: int,
    document: dict[str, Any],
) -> FolderResult:
    """Return the row of a fit; errors: views used, fitted error, its unit, held-out error."""
    mount_path = fit.calibration.transform_names[0]
    stds = [fit.std.get(f"{mount_path}.translation.{axis}") for axis in "xyz"]
    known = [std for std in stds if std is not None]
    x, y, z = (1e3 * np.asarray(fit.calibration.camera_from_mount.translation())).tolist()
    converged = fit.result.converged
    return FolderResult(
        *errors,
        (x, y, z),
        1e3 * float(np.linalg.norm(known)) if known else None,
        _outcome_words(converged, warnings),
        converged,
        document,
    )


def _outcome_words(converged: bool, warnings: int) -> str:
    if not converged:
        return "not converged"
    return f"{warnings} warning{'s' if warnings > 1 else ''}" if warnings else "good"


def _documents(names: Sequence[str], results: "Sequence[sv.fleet.Outcome]") -> list[dict[str, Any]]:
    """Return each folder's document: of a single run, or with the error in its place."""
    return [
        {"data_set": name, "error": str(outcome.error)}
        if outcome.error
        else {**outcome.result.document, "error": None}
        for name, outcome in zip(names, results, strict=True)
    ]


def _print_table(names: Sequence[str], results: "Sequence[sv.fleet.Outcome]", out: Path) -> None:
    """Print a row for each folder, then the errors and where the results are."""
    units = {outcome.result.unit for outcome in results if not outcome.error} or {"px"}
    error = "RMS" if len(units) > 1 else f"RMS {min(units)}"
    titles = ("views", error, "held out", "hand-eye (x, y, z) mm", "+-", "outcome")
    rows = [_cells(outcome, len(units) > 1) for outcome in results]
    console = Console()
    # Where the terminal is narrow, names are cut, not numbers.
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    room = console.width - sum(widths) - _GAP * len(titles) - 1
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, _GAP - 1, 0, 0))
    name_width = min(max(room, MIN_NAME_WIDTH), MAX_NAME_WIDTH)
    table.add_column("data set", max_width=name_width, overflow="ellipsis", no_wrap=True)
    for title, width in zip(titles, widths, strict=True):
        justify = "left" if title == titles[-1] else "right"
        table.add_column(title, justify=justify, min_width=width, no_wrap=True)
    for name, row in zip(names, rows, strict=True):
        table.add_row(name, *row)
    console.print(table)
    for name, outcome in zip(names, results, strict=True):
        if outcome.error:
            text = str(outcome.error)
            # Errors of files begin with a path.
            text = text if name in text else f"{name}: {text}"
            print_lines(text)
    if any(outcome.result for outcome in results):
        file = {"px": "calibration.yaml", "mm": "hand_eye.calib"}
        files = ", ".join(file[unit] for unit in sorted(units, reverse=True))
        text = f"{out}: a folder for each, with {files} and report.html"
        print_lines(text)


def _cells(outcome: "sv.fleet.Outcome", with_unit: bool) -> tuple[str, ...]:
    """Return the cells of a folder's row after its name, with the unit of the error if asked."""
    if outcome.error:
        return ("", "", "", "", "", "error")
    result: FolderResult = outcome.result
    return (
        str(result.views),
        f"{result.rms:.3f}{f' {result.unit}' if with_unit else ''}",
        "" if result.held_out_rms is None else f"{result.held_out_rms:.3f}",
        sv.geometry.vector_text(result.translation, 1),
        "held" if result.translation_std is None else f"{result.translation_std:.2f}",
        result.outcome,
    )
