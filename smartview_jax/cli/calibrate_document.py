"""Return the result of `smartview calibrate` as a JSON document for programs."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cameras import camera_to_dict
from ..report import error_summaries, rejections
from .error_documents import summary_document, views_left_out
from .json_document import transform_document

if TYPE_CHECKING:
    from ..calibration import Calibration
    from ..evaluation import ErrorBudget, SplitHalfDifference
    from ..joint import JointFit
    from .calibrate_result import CalibrateResult


def calibrate_document(
    result: "CalibrateResult", run: str, given: str, files: list[Path]
) -> dict[str, Any]:
    """Return everything that `calibrate` computed, as values for programs.

    Args:
        result: the fit and what was computed about it.
        run: name of the run, which its files contain too.
        given: the options that state prior knowledge, as text.
        files: files that were written.
    """
    fit, data = result.fit, result.data
    return {
        **fit_entries(result.name, run, given, fit.joint),
        "errors": [
            summary_document(summary)
            for summary in error_summaries(fit, data, dict(result.held_out_reports))
        ],
        "rejected": [{"view": view, "reason": reason} for view, reason in rejections(fit, data)],
        "left_out_views": views_left_out(data.masked_views),
        "undetermined": [direction.description for direction in fit.observability.null_directions],
        "halves": _halves(result.split_half),
        "budget": None if result.budget is None else budget_document(result.budget),
        "notes": list(result.notes),
        "warnings": list(result.warnings),
        "files": files,
    }


def fit_entries(name: str, run: str, given: str, joint: "JointFit") -> dict[str, Any]:
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


def calibration_entries(calibration: "Calibration") -> dict[str, Any]:
    """Return camera, transforms and target scale, as calibration files have them."""
    return {
        "mount": calibration.mount,
        "camera": camera_to_dict(calibration.camera),
        "transforms": {
            name: transform_document(transform)
            for name, transform in calibration.transforms.items()
        },
        "target_scale": float(calibration.target_scale),
    }


def _parameters(joint: "JointFit") -> list[dict[str, Any]]:
    """Return every parameter with its unit, standard deviation and 95 % half width."""
    from ..joint import parameter_estimates

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
        for parameter in parameter_estimates(joint)
    ]


def _robot_errors(joint: "JointFit") -> dict[str, Any] | None:
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


def _halves(split_half: "SplitHalfDifference | None") -> dict[str, Any] | None:
    """Return how far apart two halves of the views put the camera; None if not computed."""
    if split_half is None:
        return None
    standardised = split_half.standardised_difference
    return {
        "translation_mm": 1e3 * split_half.translation,
        "rotation_deg": float(np.rad2deg(split_half.rotation)),
        "largest_standardised_difference": None if standardised is None else np.max(standardised),
    }


def budget_document(budget: "ErrorBudget") -> dict[str, Any]:
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
