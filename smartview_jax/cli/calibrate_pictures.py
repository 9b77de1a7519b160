"""Calibrate a data set with pictures for `smartview calibrate`: fit, judge, print and write."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box

import smartview_jax as sv

from .calibrate_folder import CalibrateSettings
from .calibrate_result import AbstractResult
from .documents import budget_document, fit_entries, rejection_entries, summary_document
from .fit_options import parse_fit_options
from .terminal import print_lines, print_table, verbose

RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "calibration_staged.yaml": "the calibration of the staged pipeline",
    "calibration_uncorrected.yaml": "for programs that cannot correct the robot's error: predicts "
    "best without the correction, but its hand-eye transform is not the true one",
    "report.html": "the report: results and accuracy",
}
"""Descriptions of the files that are written, by file name."""

Fitter = Callable[
    ["sv.Dataset", Callable[[str], None] | None], "sv.calibration_pipeline.CalibrationFit"
]
"""A function from a data set and a function that is told of the progress, or None, to a fit."""


@dataclass(frozen=True)
class PictureResult(AbstractResult):
    """A fit and what was computed about it.

    Attributes:
        held_out_reports: held-out errors by method; empty where they were not computed.
        split_half: difference between halves of the views; None where it was not computed.
        budget: causes of the error; None where they were not computed.
    """

    data: "sv.Dataset"
    name: str
    fit: "sv.calibration_pipeline.CalibrationFit"
    held_out_reports: "dict[str, sv.evaluation.HeldOutReport]"
    split_half: "sv.evaluation.SplitHalfDifference | None"
    budget: "sv.evaluation.ErrorBudget | None"
    notes: tuple[str, ...]
    given: str

    @property
    def warnings(self) -> tuple[str, ...]:
        split_half = self.split_half
        return (*self.fit.warnings, *(() if split_half is None else split_half.warnings))

    @property
    def file_descriptions(self) -> dict[str, str]:
        return RESULT_FILES

    def print(self) -> None:
        fit, report = self.fit, sv.report
        columns = report.error_summaries(fit, self.data, self.held_out_reports)
        # The forms of other programs are long, and the report has them too.
        print_lines(sv.joint.fit_text(fit.joint, (), verbose(), report.headline(columns, fit)))
        print_lines(*self.remarks)
        print_table(["", *(column.name for column in columns)], report.table_rows(columns), "right")
        print_lines(report.result_summary(columns, fit))
        for column in columns:
            errors, held_out = column.reprojection_errors, column.held_out_report
            print_lines(*report.remarks(column.name, errors, held_out))
        rejected = report.rejections(fit, self.data)
        if rejected:
            print_lines("rejected:")
        print_lines(*(f"  view {view}: {reason}" for view, reason in rejected[:12]))
        if len(rejected) > 12:
            print_lines(f"  and {len(rejected) - 12} more, in the report")
        for _, text in report.repeatability_rows(self.split_half):
            print_lines(f"even and odd views: {text}")
        if self.budget is not None:
            _print_budget(self.budget)

    def write_files(self, folder: Path, run: str, progress: Callable[[str], None]) -> None:
        fit, pictures = self.fit, self.fit.picture_digests
        fit.joint.save(folder / "calibration.yaml", run, self.source, self.warnings)
        fit.staged.calibration.save(folder / "calibration_staged.yaml", run, pictures=pictures)
        if fit.calibration.robot_error is not None:
            # With the robot's error corrected, the transforms alone do not predict best.
            uncorrected = sv.calibration_pipeline.refit_uncorrected(self.data, fit)
            uncorrected.save(folder / "calibration_uncorrected.yaml", run, pictures=pictures)
        judgement = sv.report.Judgement(
            self.held_out_reports, self.split_half, self.budget, self.notes
        )
        page, origin = folder / "report.html", self.origin(run)
        sv.report.write_page(page, fit, self.data, judgement, origin, progress)

    def entries(self, run: str) -> dict[str, Any]:
        fit, data = self.fit, self.data
        return {
            **fit_entries(self.name, run, self.given, fit.joint),
            "errors": [
                summary_document(summary)
                for summary in sv.report.error_summaries(fit, data, self.held_out_reports)
            ],
            **rejection_entries(fit, data),
            "halves": _halves(self.split_half),
            "budget": None if self.budget is None else budget_document(self.budget),
        }


def calibrated_pictures(
    data: "sv.Dataset", name: str, settings: CalibrateSettings, progress: Callable[[str], None]
) -> PictureResult:
    """Fit a data set with pictures; compute held-out errors and a diagnosis if requested."""
    # The names of the transforms depend on the mount, which the data set states.
    fit_options = parse_fit_options(settings.lens, data.mount, settings.known)

    # Folds and halves are fitted with the same options as all views.
    def fitter(
        part: "sv.Dataset", progress: Callable[[str], None] | None
    ) -> "sv.calibration_pipeline.CalibrationFit":
        return sv.calibrate(
            part,
            settings.lens,
            noise=settings.noise.value,
            progress=progress,
            **fit_options.arguments(),
        )

    fit, notes = fitter(data, progress), list(data.notes)
    reports = {}
    # Views that the joint fit rejected are outliers, not a measure of the calibration.
    inlier_data = sv.evaluation.without_rejected_views(data, fit)
    if settings.held_out:
        reports = _held_out_reports(inlier_data, fitter, settings.diagnose, progress, notes)
    split_half = budget = None
    if settings.diagnose:
        split_half, budget = _diagnosis(fit, inlier_data, fitter, progress, notes)
    given = fit_options.given
    return PictureResult(data, name, fit, reports, split_half, budget, tuple(notes), given)


def _held_out_reports(
    data: "sv.Dataset",
    fitter: Fitter,
    thorough: bool,
    progress: Callable[[str], None],
    notes: list[str],
) -> "dict[str, sv.evaluation.HeldOutReport]":
    """Return the held-out errors of both fits, refitting each fold once, or add a note why not."""
    least = sv.evaluation.MIN_HELD_OUT_VIEWS
    if len(data.usable_views()) < least:
        notes.append(f"held-out error needs at least {least} usable views: left out")
        return {}
    # Progress is reported by fold; the stages of each fit would hide it.
    return sv.evaluation.held_out_reports(
        data, lambda part: fitter(part, None), thorough=thorough, progress=progress
    )


def _diagnosis(
    fit: "sv.calibration_pipeline.CalibrationFit",
    data: "sv.Dataset",
    fitter: Fitter,
    progress: Callable[[str], None],
    notes: list[str],
) -> "tuple[sv.evaluation.SplitHalfDifference | None, sv.evaluation.ErrorBudget | None]":
    """Compare halves of the views and compute the error budget; note what cannot be computed."""

    def fit_half(half_data: "sv.Dataset"):
        progress("half of the views")
        return fitter(half_data, None).joint

    # Either may be impossible, for example with too few views, while the other can be computed.
    split_half = budget = None
    try:
        split_half = sv.evaluation.split_half_difference(data, fit_half)
    except ValueError as error:
        notes.append(f"no split-half comparison: {error}")
    try:
        budget = sv.error_budget(data, fit.joint, progress, held_out_by_region=True)
    except ValueError as error:
        notes.append(f"no error budget: {error}")
    return split_half, budget


def _halves(split_half: "sv.evaluation.SplitHalfDifference | None") -> dict[str, Any] | None:
    """Return how far apart two halves of the views put the camera; None if not computed."""
    if split_half is None:
        return None
    standardised = split_half.standardised_difference
    return {
        "translation_mm": 1e3 * split_half.translation,
        "rotation_deg": float(np.rad2deg(split_half.rotation)),
        "largest_standardised_difference": None if standardised is None else np.max(standardised),
    }


def _print_budget(budget: "sv.evaluation.ErrorBudget") -> None:
    rows = [row[:2] for row in sv.report.budget_rows(budget)]
    title = "where the error comes from"
    print_table(("cause", "RMS"), rows, title=title, box=box.SIMPLE_HEAD)
    if budget.scale_hypotheses:
        names = ("one-number cause", "its size", "gain", "gain with field", "unseen regions")
        print_table(names, sv.report.scale_hypothesis_rows(budget), box=box.SIMPLE_HEAD)
    print_lines(budget.summary)
