"""Return the errors of fits and calibrations as entries of a JSON document."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..evaluation import HeldOutErrors, HeldOutReport, MethodResult, ReprojectionErrors
    from ..report import ErrorSummary


def errors_document(errors: "ReprojectionErrors") -> dict[str, Any]:
    """Return the figures of reprojection errors, px and mm at the target."""
    return {
        "mean_px": errors.mean,
        "std_px": errors.std,
        "rms_px": errors.rms,
        "rms_mm": errors.rms_mm,
        "points": len(errors.values),
        # None of the figures above includes these.
        "unpredicted_points": errors.unpredicted_count,
    }


def held_out_document(held_out: "HeldOutErrors | None") -> dict[str, Any] | None:
    """Return the held-out errors, with folds that failed or did not converge; None for none."""
    if held_out is None:
        return None
    return {
        **errors_document(held_out.errors),
        "rms_interval_95_px": list(held_out.interval()),
        "folds": len(held_out.folds),
        # Folds count from one, as in the texts on the terminal.
        "failed_folds": [{"fold": 1 + k, "reason": why} for k, why in held_out.failures],
        "unconverged_folds": [
            {"fold": 1 + k, "message": why} for k, why in held_out.unconverged_folds
        ],
    }


def summary_document(summary: "ErrorSummary") -> dict[str, Any]:
    """Return the errors of one fit: on the views it was fitted to, and on hidden ones."""
    return {
        "name": summary.name,
        "fitted": errors_document(summary.reprojection_errors),
        **_report_entries(summary.held_out_report),
    }


def method_document(row: "MethodResult") -> dict[str, Any]:
    """Return one method of a comparison; a method that failed has its reason and no errors."""
    from ..evaluation import count_rejected

    # None: the method does not report what it left out, which differs from leaving out nothing.
    left_out = None if row.rejected is None else count_rejected(row.rejected)._asdict()
    return {
        "name": row.name,
        "fitted": None if row.fitted is None else errors_document(row.fitted),
        "held_out": held_out_document(row.held_out),
        "left_out": left_out,
        "failure": row.failure,
    }


def views_left_out(masked_views: "Sequence[tuple[str, str]]") -> list[dict[str, str]]:
    """Return the views of a data set that are not used, with the reasons."""
    return [{"view": view, "reason": reason} for view, reason in masked_views]


def _report_entries(report: "HeldOutReport | None") -> dict[str, Any]:
    """Return the held-out errors of a fit: views, regions, free poses; None if not computed."""
    if report is None:
        return {"held_out": None, "held_out_by_region": None, "free_pose": None}
    entries: dict[str, Any] = {
        "held_out": held_out_document(report.held_out),
        "held_out_by_region": held_out_document(report.by_region),
        "free_pose": held_out_document(report.free_pose),
    }
    if report.predicted_error is not None:
        # Actual over predicted error; ideally 1.
        entries["over_expected"] = report.predicted_error.rms_ratio
    return entries
