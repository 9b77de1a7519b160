"""Write the report of a calibration as one HTML page that contains its pictures."""

import base64
import io
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import jinja2
import numpy as np
from matplotlib.figure import Figure

from ..calibration_pipeline import CalibrationFit
from ..dataset import Dataset
from ..detection import read_picture
from ..evaluation import ErrorBudget, HeldOutReport, SplitHalfDifference, without_rejected_views
from ..files import write_atomically
from . import plots, tables

# Text is escaped: names of views and folders come from the user's files.
get_template = jinja2.Environment(
    loader=jinja2.PackageLoader("smartview_jax.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
).get_template


def write_page(
    path: Path,
    fit: CalibrationFit,
    data: Dataset,
    held_out_reports: dict[str, HeldOutReport] | None = None,
    title: str = "Calibration",
    progress: Callable[[str], None] | None = None,
    repeatability: SplitHalfDifference | None = None,
    budget: ErrorBudget | None = None,
    notes: Sequence[str] = (),
    run: str | None = None,
) -> None:
    """Write the report of a calibration as an HTML page.

    Args:
        path: of the HTML file, which is written completely or not at all.
        fit: result of `calibrate`.
        data: data set that the fit used.
        held_out_reports: result of `evaluation.held_out_reports`, the held-out errors by method;
            None if not computed.
        title: title of the page.
        progress: called with a line of text before the plots are drawn.
        repeatability: result of `split_half_difference`; None if not computed.
        budget: result of `error_budget`; None if not computed.
        notes: notes to print, such as results that could not be computed, with the reason.
        run: name of the run, which its other files contain too.
    """
    report_progress = progress or (lambda _: None)
    rows = tables.error_summaries(fit, data, held_out_reports)
    remarks = [
        tables.remarks(row.name, row.reprojection_errors, row.held_out_report) for row in rows
    ]
    report_progress("drawing the report")
    page = get_template("page.html").render(
        title=title,
        verdict=tables.result_summary(rows, fit),
        names=[row.name for row in rows],
        table_rows=tables.table_rows(rows),
        budget=budget,
        budget_rows=[] if budget is None else tables.budget_rows(budget),
        notes=[*notes, *(line for lines in remarks for line in lines)],
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
        figures=[
            (name, text, _png_data_url(figure))
            for name, text, figure in _figures(fit, data, rows[:2])
        ],
        staged=fit.staged,
        joint=fit.joint,
        facts=_fit_facts(fit, data, held_out_reports)
        + tables.repeatability_rows(repeatability)
        + ([] if run is None else [("run", run)]),
    )
    write_atomically(path, page)


def _figures(
    fit: CalibrationFit, data: Dataset, rows: list[tables.ErrorSummary]
) -> list[tuple[str, str, Figure]]:
    """Draw the figures of the page, each with its heading and its caption."""
    calibration = fit.joint.calibration
    figures = [
        (
            "Reprojection errors",
            "Distances between measured and predicted points, over all views.",
            plots.error_histogram(rows),
        ),
        (
            "View by view",
            "One view that stands out is a wrong pose, a wrong pairing or a bad detection; views "
            "that grow worse together point at the robot.",
            plots.view_errors(data, rows),
        ),
        (
            "Over the image",
            "Residuals of the joint fit. Arrows that agree with their neighbours in all views mean "
            "that the lens model is too simple; groups of parallel arrows are views whose robot "
            "pose is off.",
            plots.residual_vectors(data, np.asarray(fit.joint.residuals)),
        ),
        (
            "Where the camera stood",
            "Cameras and target in the target's frame. Views that differ in direction and in roll "
            "about the optical axis determine the hand-eye transform.",
            plots.camera_poses_3d(data, calibration),
        ),
    ]
    overlays = [
        (
            f"Predicted centres, view {data.view_ids[view]}",
            "Cross-bars: where the joint calibration puts the target's points from the robot's "
            "pose alone. Dots: where they were measured.",
            plots.prediction_overlay(data, view, read_picture(picture), calibration),
        )
        for view, picture in _median_and_worst_views(data, rows)
    ]
    return overlays + figures


def _median_and_worst_views(
    data: Dataset, rows: list[tables.ErrorSummary]
) -> list[tuple[int, Path]]:
    """Return the views with the median and the largest error, by index, with their pictures."""
    if data.pictures is None:
        return []
    # The rows here are those of the staged and the joint fit, so the last one is the joint fit.
    errors = rows[-1].reprojection_errors.rms_per_view
    order = [int(k) for k in np.argsort(errors) if np.isfinite(errors[k])]
    views = [order[len(order) // 2], order[-1]] if len(order) > 1 else order
    return [(view, data.pictures[view]) for view in views]


def _png_data_url(figure: Figure) -> str:
    """Return a figure as a data URL with a PNG, so that the page needs no other file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _fit_facts(
    fit: CalibrationFit, data: Dataset, held_out_reports: dict[str, HeldOutReport] | None
) -> list[tuple[str, str]]:
    """Return the facts of a fit as rows of name and text, for the table at the end of the page."""
    step3 = fit.staged.step3
    used = len(without_rejected_views(data, fit).usable_views())
    facts = [
        ("views", f"{used} used of {data.view_count}, {data.mount}"),
        ("observations", f"{data.observation_count} points seen"),
        ("camera alone", f"{float(fit.staged.step2.rms):.3f} px RMS with a free pose a view"),
        ("pixel sigma", f"{float(fit.staged.step2.pixel_sigma):.3f} px of u and of v (Step 2)"),
        ("staged", fit.staged.result.message),
        (
            "Step 3",
            f"the hand-eye transforms found through either unknown differ by "
            f"{1e3 * step3.hand_eye_difference[0]:.2f} mm and "
            f"{np.rad2deg(step3.hand_eye_difference[1]):.3f} deg",
        ),
        ("joint", fit.joint.result.message),
        (
            "lengths",
            f"camera motion over robot motion {fit.staged.conventions.length_ratio:.3f}",
        ),
    ]
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
