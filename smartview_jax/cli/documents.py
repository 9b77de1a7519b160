"""Return the results of subcommands as JSON documents, for programs that call them."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import typer

import smartview_jax as sv

from ..files import finite_or_null


def print_document(subcommand: str, content: Mapping[str, Any]) -> None:
    """Print a subcommand's document with the package's version; NaN and infinity are null."""
    # The name and the version come first, so that a program can tell what it reads.
    document = {"smartview": subcommand, "version": sv.__version__, **content}
    typer.echo(json.dumps(_plain(document), indent=1, allow_nan=False))


def transform_document(transform: Any) -> dict[str, list[float]]:
    """Return a rigid transform (`jaxlie.SE3`) as calibration files have it: m, unit quaternion."""
    # jaxlie stores the quaternion first.
    numbers = np.asarray(transform.wxyz_xyz).tolist()
    return {"translation": numbers[4:], "quaternion_wxyz": numbers[:4]}


def _plain(value: Any) -> Any:
    """Return a value of lists, texts and finite numbers only."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, str | bool) or value is None:
        return value
    # Arrays of NumPy and JAX, and their scalars.
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    # After the texts, which are sequences too.
    if isinstance(value, Sequence):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return finite_or_null(value)
    return value if isinstance(value, int) else str(value)


def errors_document(errors: "sv.evaluation.ReprojectionErrors") -> dict[str, Any]:
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


def held_out_document(held_out: "sv.evaluation.HeldOutErrors | None") -> dict[str, Any] | None:
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


def summary_document(summary: "sv.report.ErrorSummary") -> dict[str, Any]:
    """Return the errors of one fit: on the views it was fitted to, and on hidden ones."""
    return {
        "name": summary.name,
        "fitted": errors_document(summary.reprojection_errors),
        **_report_entries(summary.held_out_report),
    }


def method_document(row: "sv.evaluation.MethodResult") -> dict[str, Any]:
    """Return one method of a comparison; a method that failed has its reason and no errors."""
    # None: the method does not report what it left out, which differs from leaving out nothing.
    left_out = (
        None if row.rejected is None else sv.evaluation.count_rejected(row.rejected)._asdict()
    )
    return {
        "name": row.name,
        "fitted": None if row.fitted is None else errors_document(row.fitted),
        "held_out": held_out_document(row.held_out),
        "left_out": left_out,
        "failure": row.failure,
    }


def views_left_out(masked_views: Sequence[tuple[str, str]]) -> list[dict[str, str]]:
    """Return the views of a data set that are not used, with the reasons."""
    return [{"view": view, "reason": reason} for view, reason in masked_views]


def _report_entries(report: "sv.evaluation.HeldOutReport | None") -> dict[str, Any]:
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


def rejection_entries(
    fit: "sv.calibration_pipeline.CalibrationFit | sv.JointFit", data: "sv.Dataset"
) -> dict[str, Any]:
    """Return what a fit rejected, views that it was not given, and what it cannot determine."""
    return {
        "rejected": [
            {"view": view, "reason": reason} for view, reason in sv.report.rejections(fit, data)
        ],
        "left_out_views": views_left_out(data.masked_views),
        "undetermined": [direction.description for direction in fit.observability.null_directions],
    }


def fit_entries(name: str, run: str, given: str, joint: "sv.JointFit") -> dict[str, Any]:
    """Return the entries that the documents of all joint fits begin with."""
    return {
        "data_set": name,
        "run": run,
        "given": given,
        "converged": joint.result.converged,
        "message": joint.result.message,
        **calibration_entries(joint.calibration),
        # Rotations are rotation vectors here, as on the terminal.
        "parameters": _parameters(joint),
        "robot_errors": _robot_errors(joint),
        "depth_sensor": None if joint.sensor is None else dataclasses.asdict(joint.sensor),
    }


def calibration_entries(calibration: "sv.Calibration") -> dict[str, Any]:
    """Return camera, transforms and target scale, as calibration files have them."""
    return {
        "mount": calibration.mount,
        "camera": sv.cameras.camera_to_dict(calibration.camera),
        "transforms": {
            name: transform_document(transform)
            for name, transform in calibration.transforms.items()
        },
        "target_scale": float(calibration.target_scale),
    }


def _parameters(joint: "sv.JointFit") -> list[dict[str, Any]]:
    """Return every parameter with its unit, standard deviation and 95 % half width."""
    return [
        {
            "name": parameter.name,
            "unit": parameter.unit,
            "value": parameter.value,
            # Held parameters have none, and so have undetermined ones: `held` tells which.
            "held": parameter.std is None,
            "std": parameter.std,
            "half_width_95": parameter.half_width,
        }
        for parameter in sv.joint.parameter_estimates(joint)
    ]


def _robot_errors(joint: "sv.JointFit") -> dict[str, Any] | None:
    """Return the estimated standard deviations and models of error; None if not estimated."""
    noise, estimate = joint.noise, joint.noise_estimate
    if noise is None or estimate is None:
        return None
    return {
        "model": str(estimate.name),
        "probabilities": {
            str(candidate.name): candidate.probability for candidate in estimate.candidates
        },
        "pixel_std_px": noise.pixel,
        "within_view_std_px": noise.within_view_pixel,
        "position_std_mm": 1e3 * noise.translation,
        "angle_std_deg": float(np.rad2deg(noise.rotation)),
        "converged": estimate.converged,
    }


def budget_document(budget: "sv.evaluation.ErrorBudget") -> dict[str, Any]:
    """Return the causes of the error, largest first."""
    return {
        "total_rms_px": budget.total_rms,
        "causes": [
            {"name": cause.name, "rms_px": cause.rms, "advice": cause.advice}
            for cause in budget.causes
        ],
        # All of these explain the same smooth error by one number; only a measurement can decide.
        "scale_hypotheses": [
            {
                "name": hypothesis.name,
                "scale": hypothesis.scale,
                "std": hypothesis.std,
                "deviance_decrease": hypothesis.log_likelihood_ratio,
                "deviance_decrease_by_field": hypothesis.field_log_likelihood_ratio,
                "held_out_by_region_rms_px": hypothesis.region_rms,
            }
            for hypothesis in budget.scale_hypotheses
        ],
        "summary": budget.summary,
    }
