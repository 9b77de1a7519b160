"""Format the results of a calibration as rows of text, for the terminal and the HTML page."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..calibration_pipeline import CalibrationFit
from ..dataset import MINIMUM_RELIABLE_VIEWS, Dataset
from ..evaluation import (
    UNCORRECTED_SUFFIX,
    ErrorBudget,
    HeldOutErrors,
    HeldOutReport,
    MethodResult,
    ReprojectionErrors,
    SplitHalfDifference,
    count_rejected,
    has_correction,
    rejected_by,
    reprojection_errors,
    without_rejected_views,
)
from ..joint import JointFit, outcome, parameter_estimates
from ..variance import NoiseEstimate


class ErrorSummary(NamedTuple):
    """The errors of one fit, which are one column of the table of results.

    Attributes:
        reprojection_errors: reprojection errors on all views that were not rejected.
        held_out_report: held-out errors; None where they were not computed.
    """

    name: str
    reprojection_errors: ReprojectionErrors
    held_out_report: HeldOutReport | None

    @property
    def held_out(self) -> HeldOutErrors | None:
        """The held-out error by view; None where it was not computed."""
        return None if self.held_out_report is None else self.held_out_report.held_out


def error_summaries(
    fit: CalibrationFit, data: Dataset, held_out_reports: dict[str, HeldOutReport] | None = None
) -> list[ErrorSummary]:
    """Return the errors of the staged and the joint fit.

    If the joint fit corrects the robot's error, a third row has its errors without the correction.
    Views that the joint fit rejected entirely are left out for all fits.
    """
    held_out_reports, data = held_out_reports or {}, without_rejected_views(data, fit)
    calibrations = {"staged": fit.staged.calibration, "joint": fit.joint.calibration}
    if has_correction(fit.joint):
        calibrations[f"joint, {UNCORRECTED_SUFFIX}"] = fit.joint.calibration.uncorrected
    return [
        ErrorSummary(name, reprojection_errors(calibration, data), held_out_reports.get(name))
        for name, calibration in calibrations.items()
    ]


MEASURE_NAMES = (
    "reprojection error, mean +- std",
    "reprojection error, RMS",
    "held-out error, RMS",
    "  its 95 % interval over views",
    "  at the target",
    "  actual / predicted error (ideal: 1)",
    "  with a free pose for each view",
    "held-out by region, RMS",
)
"""The names of the rows of the table of results."""


def summary_column(summary: ErrorSummary) -> list[str]:
    """Return one column of the table of results: a text for each of `MEASURE_NAMES`."""
    texts = [
        f"{summary.reprojection_errors.mean:.2f} +- {summary.reprojection_errors.std:.2f} px",
        f"{summary.reprojection_errors.rms:.2f} px",
    ]
    held_out_report = summary.held_out_report
    if held_out_report is None:
        return texts + ["-"] * (len(MEASURE_NAMES) - len(texts))
    low, high = held_out_report.held_out.interval()
    return [
        *texts,
        f"{held_out_report.held_out.errors.rms:.2f} px",
        f"{low:.2f} to {high:.2f} px",
        f"{held_out_report.held_out.errors.rms_mm:.2f} mm",
        "-"
        if held_out_report.predicted_error is None
        else f"{held_out_report.predicted_error.rms_ratio:.2f}",
        "-"
        if held_out_report.free_pose is None
        else f"{held_out_report.free_pose.errors.rms:.2f} px",
        "-"
        if held_out_report.by_region is None
        else f"{held_out_report.by_region.errors.rms:.2f} px",
    ]


def table_rows(rows: Sequence[ErrorSummary]) -> list[tuple[str, ...]]:
    """Return the rows of the table that have a number, each beginning with its measure."""
    columns = [summary_column(row) for row in rows]
    return [row for row in zip(MEASURE_NAMES, *columns, strict=True) if set(row[1:]) != {"-"}]


COMPARISON_HEADINGS = (
    "method",
    "mean +- std, px",
    "RMS, px",
    "held out, px",
    "95 % interval, px",
    "held out, mm",
    "left out points, views",
)
"""Headings of the columns of the comparison of methods."""


def comparison_row(row: MethodResult) -> list[str]:
    """Return one row of the comparison of methods: a text for each of `COMPARISON_HEADINGS`."""
    if row.fitted is None or row.held_out is None:
        return [row.name, "failed", *["-"] * (len(COMPARISON_HEADINGS) - 2)]
    held_out_errors = row.held_out.errors
    counts = None if row.rejected is None else count_rejected(row.rejected)
    return [
        row.name,
        f"{row.fitted.mean:.3g} +- {row.fitted.std:.3g}",
        f"{row.fitted.rms:.3g}",
        f"{held_out_errors.rms:.3g}",
        "{:.3g} to {:.3g}".format(*row.held_out.interval()),
        f"{held_out_errors.rms_mm:.3g}",
        "-" if counts is None else f"{counts.points}, {counts.views}",
    ]


def remarks(
    name: str,
    fitted_errors: ReprojectionErrors | None,
    held_out_report: HeldOutReport | None,
    failure: str | None = None,
) -> list[str]:
    """Return remarks on the numbers of a table: failed fits, and points that are left out."""
    lines = [] if failure is None else [f"{name}: {failure}"]
    if fitted_errors is not None and fitted_errors.unpredicted_count:
        count = fitted_errors.unpredicted_count
        lines.append(f"{name}: {count} points seen cannot be predicted at all")
    if held_out_report is None:
        return lines
    lines += _held_out_remarks(name, held_out_report.held_out)
    if held_out_report.by_region is not None:
        lines += _held_out_remarks(f"{name}, by region", held_out_report.by_region)
    # A fold whose refit failed has been reported above.
    reported_folds = {number for number, _ in held_out_report.held_out.failures}
    predicted_error = held_out_report.predicted_error
    for label, held_out in (
        ("with a free pose", held_out_report.free_pose),
        ("predicted error", None if predicted_error is None else predicted_error.predicted),
    ):
        for number, reason in () if held_out is None else held_out.failures:
            if number not in reported_folds:
                lines.append(f"{name}, {label}: fold {number + 1} failed: {reason}")
    return lines


def _held_out_remarks(name: str, held_out: HeldOutErrors) -> list[str]:
    """Return remarks on held-out points without prediction, extrapolation, and failed folds."""
    lines = []
    if held_out.errors.unpredicted_count:
        count = held_out.errors.unpredicted_count
        lines.append(f"{name}: {count} held-out points seen cannot be predicted at all")
    if held_out.extrapolated_views:
        count, total = len(held_out.extrapolated_views), sum(map(len, held_out.folds))
        lines.append(
            f"{name}: {count} of {total} held-out views lie outside the hull of the remaining "
            "viewpoints: extrapolated"
        )
    lines += [f"{name}: fold {k + 1} failed: {reason}" for k, reason in held_out.failures]
    lines += [
        f"{name}: fold {k + 1} did not converge: {why}" for k, why in held_out.unconverged_folds
    ]
    return lines


def rejections(fit: CalibrationFit | JointFit, data: Dataset) -> list[tuple[str, str]]:
    """Return views and reasons of rejection: whole views first, then counts of rejected points."""
    view_reasons, rejected_points = {}, {}
    # A rejection without a point concerns the whole view. The sets count every point once.
    for view, point, reason in rejected_by(fit) or ():
        if point is None:
            view_reasons[view] = reason
        else:
            rejected_points.setdefault((view, reason), set()).add(point)
    lines = [(view, f"not used: {reason}") for view, reason in view_reasons.items()]
    order = {view: k for k, view in enumerate(data.view_ids)}
    for (view, reason), indices in sorted(
        rejected_points.items(), key=lambda item: order[item[0][0]]
    ):
        lines.append((view, f"{len(indices)} points {reason}"))
    return lines


def error_model_rows(joint: JointFit, data: Dataset) -> list[tuple[str, str]]:
    """Return the estimated variance components and robot error model as rows; empty if none."""
    noise, estimate = joint.noise, joint.noise_estimate
    if noise is None or estimate is None:
        return []
    within_view_text = (
        "" if noise.white_pixel is None else f" (within a view {noise.white_pixel:.3f})"
    )
    # With a relative standard deviation of 100 % or more the variance component may as well be
    # zero, so the deviation is not printed.
    relative_std_texts = [
        f" +- {relative:.0%}" if relative < 1.0 else "" for relative in estimate.relative_std
    ]
    lines = [
        robot_error_row(estimate),
        (
            "standard deviations",
            f"pixels {noise.pixel:.3f} px{relative_std_texts[0]}{within_view_text}; "
            f"poses, white noise, "
            f"{1e3 * noise.translation:.3f} mm{relative_std_texts[1]} and "
            f"{np.rad2deg(noise.rotation):.4f} deg{relative_std_texts[2]}",
        ),
    ]
    if joint.calibration.robot_error is not None:
        uncorrected_rms = reprojection_errors(joint.calibration.uncorrected, data).rms
        lines.append(
            (
                "without the correction",
                f"{uncorrected_rms:.2f} px RMS: the error of a program that uses these transforms "
                "without the robot's correction",
            )
        )
    if not estimate.converged:
        lines.append(("standard deviations", "the search ended before they converged: be careful"))
    return lines


def robot_error_row(estimate: NoiseEstimate) -> tuple[str, str]:
    """Return a row with the model of the robot's error and the probabilities of all models."""
    probabilities = ", ".join(
        f"{candidate.name} {candidate.probability:.2f}"
        for candidate in sorted(estimate.candidates, key=lambda c: -c.probability)
        if candidate.probability >= 0.005
    )
    name = _model_with_description(estimate.name)
    field = estimate.field
    about = ", about the errors of its type" if field is not None and field.is_about_type else ""
    return "errors of the robot", f"{name}{about}; probabilities: {probabilities}"


MODEL_DESCRIPTIONS = {
    "white": "of every pose independently",
    "position": "smooth, linear in the tool's position",
    "pose": "smooth, linear in the tool's pose",
    "position_squared": "smooth, quadratic in the tool's position, as of an arm that bends",
    "pose_squared": "smooth, quadratic in the tool's position and linear in its orientation",
    "six_axis_arm": "of a six-axis arm derived from the poses",
    "joint_offsets": "zeros of the joints",
    "dh": "zeros of the joints, lengths and twists of the links",
    "elastic_dh": "zeros and compliances of the joints, lengths and twists of the links",
}
"""Descriptions of the robot error models, by name."""


def _model_with_description(name: str) -> str:
    """Return the name of a robot error model with its description."""
    return f"{name} ({MODEL_DESCRIPTIONS[name]})" if name in MODEL_DESCRIPTIONS else name


def model_counts_text(names: Iterable[str]) -> str:
    """Return a clause that counts the robot error models of refits; empty if there were none."""
    counts = Counter(names).most_common()
    listed = ", ".join(f"{name} {count}" for name, count in counts)
    return f"; robot error models in the folds: {listed}" if counts else ""


def repeatability_rows(repeatability: SplitHalfDifference | None) -> list[tuple[str, str]]:
    """Return a row with the hand-eye difference of two halves of the views; empty if unknown."""
    if repeatability is None:
        return []
    estimates = [getattr(fit, "noise_estimate", None) for fit in repeatability.fits]
    model_counts = model_counts_text(
        estimate.name for estimate in estimates if estimate is not None
    )
    text = f"their hand-eye transforms are {repeatability.description}{model_counts}"
    return [("even and odd views", text)]


def budget_rows(budget: ErrorBudget) -> list[tuple[str, str, str]]:
    """Return each cause of error, its RMS in the uncorrected chain and an advice, largest first."""
    return [(cause.name, f"{cause.rms:.3g} px", cause.advice) for cause in budget.causes]


def scale_hypothesis_rows(budget: ErrorBudget) -> list[tuple[str, str, str, str, str]]:
    """Return rows on the hypotheses that explain the robot's error by a single scale.

    A row has the name, the scale, the decrease of the deviance (and the decrease by a robot error
    field instead), the further decrease in addition to that field, and the held-out RMS by region.
    """
    return [
        (
            hypothesis.name,
            f"{hypothesis.scale:.4f} +- {hypothesis.std:.4f}",
            f"{hypothesis.log_likelihood_ratio:.0f}; "
            f"a field {hypothesis.field_log_likelihood_ratio:.0f}",
            f"{hypothesis.log_likelihood_ratio_given_field:.1f}",
            "" if hypothesis.region_rms is None else f"{hypothesis.region_rms:.3g} px",
        )
        for hypothesis in budget.scale_hypotheses
    ]


def parameter_rows(fit: CalibrationFit) -> list[tuple[str, str, str]]:
    """Return the name, value with unit, and standard deviation of the joint fit's parameters."""
    rows = []
    for estimate in parameter_estimates(fit.joint):
        if estimate.std is None:
            std_text = "held"
        else:
            std_text = f"{estimate.std:.2g}" if np.isfinite(estimate.std) else "not determined"
        rows.append((estimate.name, f"{estimate.value:.6g} {estimate.unit}".strip(), std_text))
    return rows


def headline(rows: Sequence[ErrorSummary], fit: CalibrationFit) -> str:
    """Return the outcome of the joint fit in one line, with the RMS of the tables."""
    errors = rows[1].reprojection_errors
    seen = errors.values.size
    left_out = seen - int(np.asarray(fit.joint.inliers).sum())
    # Points left out as gross errors count in the RMS, as in the column of every other method.
    but = f" ({left_out} points left out of the fit)" if left_out > 0 else ""
    return (
        f"joint fit: {errors.rms:.2f} px RMS over {seen} points in "
        f"{int(np.isfinite(errors.rms_per_view).sum())} views{but}; {outcome(fit.joint)}"
    )


def result_summary(rows: list[ErrorSummary], fit: CalibrationFit) -> str:
    """Return a summary of the result in a few sentences."""
    if not fit.joint.result.converged:
        return f"The joint fit did not converge: {fit.joint.result.message}."
    staged, joint = rows[:2]
    rms = [staged.reprojection_errors.rms, joint.reprojection_errors.rms]
    evaluated_on = "on the views that it was fitted to"
    if staged.held_out is not None and joint.held_out is not None:
        held_out_rms = [staged.held_out.errors.rms, joint.held_out.errors.rms]
        # Without a successful fold the held-out RMS is not finite, and the errors of fitted views
        # are reported instead.
        if np.isfinite(held_out_rms).all():
            rms, evaluated_on = held_out_rms, "on views it never saw"
    # With a free pose for every view only errors of the camera model and the detections remain: no
    # calibration of the whole chain can be expected to do better.
    floor = float(fit.staged.step2.rms)
    text = (
        f"The joint fit predicts target points to {rms[1]:.2f} px RMS {evaluated_on}; "
        f"the staged pipeline to {rms[0]:.2f} px. "
        f"With a free pose for every view the camera alone would reach {floor:.2f} px"
    )
    # Far above this floor the camera is not the limiting factor.
    if rms[1] > 3.0 * floor:
        text += ": the rest comes from the robot's poses, the target's size or too few views."
    else:
        text += "."
    views = len(joint.reprojection_errors.rms_per_view)
    used = int(np.isfinite(joint.reprojection_errors.rms_per_view).sum())
    rejected_count = count_rejected(rejected_by(fit) or ()).views
    if rejected_count:
        verb = "is" if rejected_count == 1 else "are"
        text += f" Of {views} views {rejected_count} {verb} rejected and not counted."
    if used < MINIMUM_RELIABLE_VIEWS:
        text += f" With {used} views no figure here is reliable: take "
        text += f"{MINIMUM_RELIABLE_VIEWS} at least."
    return text
