"""Write the report of a calibration as one HTML page that contains its pictures."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import plots
from ..calibration import Calibration
from ..calibration_pipeline import CalibrationFit
from ..cameras import lens_name
from ..dataset import Dataset
from ..detection import read_picture
from ..evaluation import (
    ErrorBudget,
    HeldOutReport,
    SplitHalfDifference,
    picture_uncertainty,
    without_rejected_views,
)
from ..files import write_atomically
from ..joint import estimate_groups, hand_eye_forms
from ..version import __version__
from . import tables
from .next_steps import hand_eye_sentence, next_steps
from .story import PageFigure, Section, StoryFigure, get_template, page_figure, write_story
from .tables import ErrorSummary


class Origin(NamedTuple):
    """The data set and the command of a page, so that a reader can reproduce it.

    Attributes:
        source: name of the data set.
        command: the command that was run; empty for a page written by a script.
        run: name of the run, which is also in its other files; None without other files.
        given: what was known beforehand instead of fitted, in words.
    """

    source: str
    command: str = ""
    run: str | None = None
    given: str = ""


def page_title(origin: Origin | None) -> str:
    """Return the title of a calibration's page."""
    return "Calibration" if origin is None else f"Calibration of {origin.source}"


def origin_facts(origin: Origin | None) -> list[tuple[str, str]]:
    """Return rows on the data set and the command, as far as they are known."""
    if origin is None:
        return []
    names = ("data set", "command", "given", "run")
    texts = (origin.source, origin.command, origin.given, origin.run)
    return [(name, text) for name, text in zip(names, texts, strict=True) if text]


class Judgement(NamedTuple):
    """The results of the checks of a calibration, for its page.

    Attributes:
        held_out_reports: result of `evaluation.held_out_reports`, the held-out errors by method;
            None if not computed.
        repeatability: result of `split_half_difference`; None if not computed.
        budget: result of `error_budget`; None if not computed.
        notes: notes to print, such as results that could not be computed, with the reason; None
            for the notes of the data set.
    """

    held_out_reports: dict[str, HeldOutReport] | None = None
    repeatability: SplitHalfDifference | None = None
    budget: ErrorBudget | None = None
    notes: Sequence[str] | None = None


def write_page(
    path: Path,
    fit: CalibrationFit,
    data: Dataset,
    judgement: Judgement | None = None,
    origin: Origin | None = None,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Write the report of a calibration as an HTML page.

    Args:
        path: of the HTML file, which is written completely or not at all.
        judgement: how accurate the result is; None if nothing was computed.
        origin: data set and command of the page; None for a script's own data.
        progress: called with a line of text before the plots are drawn.
    """
    held_out_reports, repeatability, budget, notes = judgement or Judgement()
    report_progress = progress or (lambda _: None)
    rows = tables.error_summaries(fit, data, held_out_reports)
    remarks = [
        tables.remarks(row.name, row.reprojection_errors, row.held_out_report) for row in rows
    ]
    doubts_by_halves = () if repeatability is None else repeatability.warnings
    report_progress("drawing the report")
    page = get_template("page.html").render(
        title=page_title(origin),
        run_line=_run_line(origin),
        verdict=[hand_eye_sentence(fit.joint), tables.result_summary(rows, fit)],
        headline=tables.headline(rows, fit),
        warnings=[*fit.warnings, *doubts_by_halves],
        hand_eye_forms=hand_eye_forms(fit.joint),
        data_set="data given by a script" if origin is None else origin.source,
        next_steps=next_steps(fit, data, rows),
        estimate_groups=estimate_groups(fit.joint)[:3],
        names=[row.name for row in rows],
        table_rows=tables.table_rows(rows),
        budget=budget,
        budget_rows=[] if budget is None else tables.budget_rows(budget),
        notes=[
            *(data.notes if notes is None else notes),
            *(line for lines in remarks for line in lines),
        ],
        scale_hypothesis_rows=[] if budget is None else tables.scale_hypothesis_rows(budget),
        rejections=tables.rejections(fit, data),
        null_directions=[d.description for d in fit.joint.observability.null_directions],
        weak_directions=[
            f"{d.description} (singular value {d.singular_value:.1e})"
            for d in fit.joint.observability.weak_directions
        ],
        parameters=tables.parameter_rows(fit),
        errors_estimated=fit.joint.noise_estimate is not None,
        # The first two rows: the staged and the joint fit, without the uncorrected one.
        figures=_figures(fit, data, rows[:2]),
        scene=plots.interactive_cameras(
            data, fit.joint.calibration, rows[1].reprojection_errors.rms_per_view
        ).html(),
        staged=fit.staged,
        joint=fit.joint,
        facts=origin_facts(origin)
        + _fit_facts(fit, data, held_out_reports)
        + tables.repeatability_rows(repeatability),
    )
    write_atomically(path, page)


def _run_line(origin: Origin | None) -> str:
    """Return the date and the version for the line under the page's title."""
    parts = [f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", f"smartview-jax {__version__}"]
    return " \u00b7 ".join(parts if origin is None or origin.run is None else [*parts, origin.run])


def _figures(
    fit: CalibrationFit, data: Dataset, rows: list[tables.ErrorSummary]
) -> list[PageFigure]:
    """Draw the figures of the page, each with its heading and its caption."""
    calibration = fit.joint.calibration
    errors = {row.name: row.reprojection_errors for row in rows}
    overlays = [
        page_figure(f"Predicted centres, view {name}.", f"Of the joint fit. {caption}", overlay)
        # The rows are the staged and the joint fit.
        for name, caption, overlay in prediction_overlays(data, rows[-1], calibration)
    ]
    return [
        *overlays,
        page_figure(
            "Reprojection errors.",
            "Distances between measured and predicted points, over all views.",
            plots.error_histogram(errors),
        ),
        *_uncertainty_figures(fit, data),
        page_figure(
            "View by view.",
            "A single view that stands out has a wrong pose, a wrong pairing or a bad detection; "
            "views that get worse together point to the robot.",
            plots.view_errors(data, errors),
        ),
        page_figure(
            "Over the image.",
            "Residuals of the joint fit. Arrows that agree with their neighbours in all views mean "
            "that the lens model is too simple; groups of parallel arrows are views whose robot "
            "pose is off.",
            plots.residual_vectors(data, np.asarray(fit.joint.residuals)),
        ),
    ]


def _uncertainty_figures(fit: CalibrationFit, data: Dataset) -> list[PageFigure]:
    """Draw the uncertainty of predicted pixels; nothing if something is undetermined."""
    # Views without any used point tell nothing about the depth.
    if fit.joint.observability.null_directions or not np.asarray(data.visible).any():
        return []
    return [
        page_figure(
            "How well pixels are predicted.",
            "Standard deviation of predicted pixels through the whole chain, without the noise of "
            "a single pose: small where targets were seen, large where the calibration "
            "extrapolates.",
            plots.picture_uncertainty(picture_uncertainty(fit.joint, data)),
        )
    ]


def prediction_overlays(
    data: Dataset, summary: tables.ErrorSummary, calibration: Calibration
) -> list[tuple[str, str, plots.PlotFigure]]:
    """Draw the predictions in two views, of median and of largest error: name, caption, figure."""
    if data.pictures is None:
        return []
    caption = (
        "Crosses: points predicted by the calibration from the robot's pose alone. Rings: measured "
        "points."
    )
    errors = summary.reprojection_errors.rms_per_view
    order = [int(k) for k in np.argsort(errors) if np.isfinite(errors[k])]
    views = [order[len(order) // 2], order[-1]] if len(order) > 1 else order
    return [
        (
            data.view_ids[view],
            caption,
            plots.prediction_overlay(data, view, read_picture(data.pictures[view]), calibration),
        )
        for view in views
    ]


def _fit_facts(
    fit: CalibrationFit, data: Dataset, held_out_reports: dict[str, HeldOutReport] | None
) -> list[tuple[str, str]]:
    """Return the facts of a fit as rows of name and text, for the table at the end of the page."""
    step3 = fit.staged.step3
    used = len(without_rejected_views(data, fit).usable_views())
    camera = fit.calibration.camera
    width, height = camera.image_size
    target = "points given as arrays" if data.target is None else type(data.target).__name__
    facts = [
        ("camera and lens", f"{width} x {height} px, {lens_name(camera.lens)}"),
        ("target", f"{target}, {data.points.shape[-2]} points"),
        ("views", f"{used} used of {data.view_count}, {data.mount}"),
        ("observations", f"{data.observation_count} points seen"),
        (
            "camera alone",
            f"{float(fit.staged.step2.rms):.3f} px RMS with a free pose for each view",
        ),
        ("pixel sigma", f"{float(fit.staged.step2.pixel_sigma):.3f} px of u and of v (Step 2)"),
        ("staged", fit.staged.result.message),
        (
            "Step 3",
            f"the hand-eye transforms from the two elimination orders differ by "
            f"{1e3 * step3.hand_eye_difference[0]:.2f} mm and "
            f"{np.rad2deg(step3.hand_eye_difference[1]):.3f} deg",
        ),
        ("joint", fit.joint.result.message),
        (
            "lengths",
            f"camera motion over robot motion {fit.staged.conventions.length_ratio:.3f}",
        ),
    ]
    if fit.joint.sensor is not None:
        facts.append(("depth sensor", fit.joint.sensor.described))
    facts += tables.error_model_rows(fit.joint, data)
    if held_out_reports:
        held_out_report = held_out_reports.get("joint", next(iter(held_out_reports.values())))
        text = f"{len(held_out_report.held_out.folds)} folds by view, all refitted in each"
        facts.append(
            ("held-out error", text + tables.model_counts_text(held_out_report.error_models))
        )
    libraries = ", ".join(f"{name} {version(name)}" for name in ("jax", "optimistix", "numpy"))
    facts.append(("computed with", libraries))
    return facts


def write_evaluation_page(
    path: Path,
    title: str,
    verdict: str,
    calibration: Calibration,
    data: Dataset,
    summaries: Sequence[ErrorSummary],
    rows: Sequence[Sequence[str]],
) -> None:
    """Write the figures of the paper's evaluation: Fig. 7, and Fig. 1 in two of the pictures.

    Args:
        verdict: the result in a sentence.
        calibration: the first calibration, used for predictions in the pictures.
        data: the predicted views.
        summaries: errors of every calibration.
        rows: the table, with the names of the calibrations in the first row.
    """
    errors = {summary.name: summary.reprojection_errors for summary in summaries}
    histogram = StoryFigure(
        "Fig. 7.",
        "Distances between measured and predicted points.",
        plots.error_histogram(errors),
    )
    by_view = StoryFigure(
        "RMS of each view.",
        "A view that stands out has a wrong pose or a bad detection.",
        plots.view_errors(data, errors),
    )
    sections = [
        Section("Errors", header=rows[0], rows=rows[1:]),
        Section("Over all points", figures=[histogram]),
        Section("View by view", figures=[by_view]),
    ]
    overlays = [
        StoryFigure(f"Fig. 1, view {name}.", caption, overlay)
        for name, caption, overlay in prediction_overlays(data, summaries[0], calibration)
    ]
    if overlays:
        sections.append(Section("In the pictures", figures=overlays))
    write_story(path, title, verdict, sections)
