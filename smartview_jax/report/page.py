"""Write the report of a calibration as one HTML page that contains its pictures."""

import base64
import io
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import jinja2
import numpy as np
from matplotlib.figure import Figure

from ..calibrate_data import CalibrationFit
from ..dataset import Dataset
from ..detection import read_picture
from ..evaluation import ErrorBudget, Repeatability, Unseen, without_rejected_views
from ..files import write_atomically
from . import plots, tables

_TEMPLATE = jinja2.Environment(
    loader=jinja2.PackageLoader("smartview_jax.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
).get_template


def write_page(
    path: Path,
    fit: CalibrationFit,
    data: Dataset,
    unseen: dict[str, Unseen] | None = None,
    title: str = "Calibration",
    progress: Callable[[str], None] | None = None,
    halves: Repeatability | None = None,
    budget: ErrorBudget | None = None,
    notes: Sequence[str] = (),
    run: str | None = None,
) -> None:
    """Write the report of a calibration as an HTML page.

    Args:
        path: of the HTML file, which is written completely or not at all.
        fit: result of `calibrate`.
        data: data set that the fit used.
        unseen: result of `unseen_errors`, the held-out errors by method; None if not computed.
        title: title of the page.
        progress: called with a line of text before the plots are drawn.
        halves: result of `repeatability`; None if not computed.
        budget: result of `error_budget`; None if not computed.
        notes: notes to print, such as results that could not be computed, with the reason.
        run: name of the run, which its other files contain too.
    """
    say = progress or (lambda _: None)
    rows = tables.summaries(fit, data, unseen)
    remarks = [tables.remarks(row.name, row.fitted, row.unseen) for row in rows]
    say("drawing the report")
    page = _TEMPLATE("page.html").render(
        title=title,
        verdict=tables.verdict(rows, fit),
        names=[row.name for row in rows],
        measures=tables.table_rows(rows),
        budget=budget,
        budget_rows=[] if budget is None else tables.budget_rows(budget),
        notes=[*notes, *(line for lines in remarks for line in lines)],
        explanation_rows=[] if budget is None else tables.explanation_rows(budget),
        rejections=tables.rejections(fit, data),
        blind=[d.words for d in fit.joint.observability.null],
        weak=[
            f"{d.words} (singular value {d.singular_value:.1e})"
            for d in fit.joint.observability.weak
        ],
        parameters=tables.parameter_rows(fit),
        errors_estimated=fit.joint.estimate is not None,
        figures=[
            (name, text, _embedded(figure)) for name, text, figure in _figures(fit, data, rows[:2])
        ],
        staged=fit.staged,
        joint=fit.joint,
        facts=_facts(fit, data, unseen)
        + tables.halves_agree(halves)
        + ([] if run is None else [("run", run)]),
    )
    write_atomically(path, page)


def _figures(
    fit: CalibrationFit, data: Dataset, rows: list[tables.Summary]
) -> list[tuple[str, str, Figure]]:
    """Draw the figures of the page, each with its heading and its caption."""
    calibration = fit.joint.calibration
    found = [
        (
            "How far off",
            "Deviations between measured and predicted centres, over all views.",
            plots.deviation_histogram(rows),
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
            plots.views_in_space(data, calibration),
        ),
    ]
    shown = [
        (
            f"Predicted centres, view {data.view_ids[view]}",
            "Cross-bars: where the joint calibration puts the target's points from the robot's "
            "pose alone. Dots: where they were measured.",
            plots.cross_bars(data, view, read_picture(picture), calibration),
        )
        for view, picture in _typical_and_worst(data, rows)
    ]
    return shown + found


def _typical_and_worst(data: Dataset, rows: list[tables.Summary]) -> list[tuple[int, Path]]:
    """Return the views with the median and the largest error, by index, with their pictures."""
    if data.pictures is None:
        return []
    # The rows here are those of the staged and the joint fit, so the last one is the joint fit.
    errors = rows[-1].fitted.per_view
    order = [int(k) for k in np.argsort(errors) if np.isfinite(errors[k])]
    views = [order[len(order) // 2], order[-1]] if len(order) > 1 else order
    return [(view, data.pictures[view]) for view in views]


def _embedded(figure: Figure) -> str:
    """Return a figure as a data URL with a PNG, so that the page needs no other file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _facts(
    fit: CalibrationFit, data: Dataset, unseen: dict[str, Unseen] | None
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
            "Step 3, two ways",
            f"the hand-eye transforms differ by {1e3 * step3.difference[0]:.2f} mm and "
            f"{np.rad2deg(step3.difference[1]):.3f} deg",
        ),
        ("joint", fit.joint.result.message),
        (
            "lengths",
            f"camera motion over robot motion {fit.staged.conventions.length_ratio:.3f}",
        ),
    ]
    facts += tables.errors_found(fit.joint, data)
    if unseen:
        part = unseen.get("joint", next(iter(unseen.values())))
        text = f"{len(part.held_out.folds)} folds by view, all refitted in each"
        facts.append(("held-out error", text + tables.models_chosen(part.models)))
    libraries = ", ".join(f"{name} {version(name)}" for name in ("jax", "optimistix", "numpy"))
    facts.append(("computed with", libraries))
    return facts
