"""Print the tables of `smartview calibrate`: errors, rejections and the error budget."""

import logging
from typing import TYPE_CHECKING

import typer
from rich import box
from rich.console import Console
from rich.table import Table

from ..report import (
    budget_rows,
    error_summaries,
    headline,
    rejections,
    remarks,
    repeatability_rows,
    result_summary,
    scale_hypothesis_rows,
    table_rows,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..calibration_pipeline import CalibrationFit
    from ..dataset import Dataset
    from ..evaluation import ErrorBudget
    from ..report import ErrorSummary
    from .calibrate_result import CalibrateResult


def print_calibrate_result(result: "CalibrateResult") -> None:
    """Print the calibration, its errors and the error budget."""
    rows = error_summaries(result.fit, result.data, result.held_out_reports)
    _print_errors(rows, result.fit, result.data, result.remarks)
    for _, text in repeatability_rows(result.split_half):
        typer.echo(f"even and odd views: {text}")
    if result.budget is not None:
        _print_budget(result.budget)


def verbose() -> bool:
    """Return whether the command was called with -v."""
    return logging.getLogger(__package__).isEnabledFor(logging.INFO)


def _print_errors(
    rows: "list[ErrorSummary]", fit: "CalibrationFit", data: "Dataset", notes: "Sequence[str]"
) -> None:
    """Print the calibration with its uncertainty, notes and warnings, errors and rejections."""
    from ..joint import fit_text

    console = Console()
    # The forms of other programs are long, and the report has them too.
    text = fit_text(fit.joint, (), verbose(), headline(rows, fit))
    console.print(text, highlight=False, markup=False)
    for note in notes:
        console.print(note, highlight=False, markup=False)
    table = Table()
    table.add_column("")
    for row in rows:
        table.add_column(row.name, justify="right")
    for texts in table_rows(rows):
        table.add_row(*texts)
    console.print(table)
    console.print(result_summary(rows, fit))
    for row in rows:
        for remark in remarks(row.name, row.reprojection_errors, row.held_out_report):
            console.print(remark, highlight=False, markup=False)
    rejected = rejections(fit, data)
    if rejected:
        console.print("rejected:")
    for view, reason in rejected[:12]:
        console.print(f"  view {view}: {reason}", highlight=False, markup=False)
    if len(rejected) > 12:
        console.print(f"  and {len(rejected) - 12} more, in the report")


def _print_budget(budget: "ErrorBudget") -> None:
    """Print the error budget, and the scale hypotheses if there are any."""
    table = Table("cause", "RMS", title="where the error comes from", box=box.SIMPLE_HEAD)
    for name, px, _ in budget_rows(budget):
        table.add_row(name, px)
    console = Console()
    console.print(table)
    if budget.scale_hypotheses:
        names = ("one-number cause", "its size", "gain", "gain with field", "unseen regions")
        table = Table(*names, box=box.SIMPLE_HEAD)
        for row in scale_hypothesis_rows(budget):
            table.add_row(*row)
        console.print(table)
    console.print(budget.summary, highlight=False)
