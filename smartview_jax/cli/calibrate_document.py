"""Return the result of `smartview calibrate` as a JSON document for programs."""

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
    """Return all that `calibrate` found, as values for programs.

    Args:
        result: the fit and what was computed about it.
        run: name of the run, which its files contain too.
        given: what was known already, in words.
        files: files that were written.
    """
    fit, data = result.fit, result.data
    return {
        "data_set": result.name,
        "run": run,
        "given": given,
        "converged": fit.result.converged,
        "message": fit.result.message,
        **calibration_entries(fit.calibration),
        # Rotations are rotation vectors here, as on the terminal.
        "parameters": _parameters(fit.joint),
        "robot_errors": _robot_errors(fit.joint),
        "errors": [
            summary_document(one)
            for one in error_summaries(fit, data, dict(result.held_out_reports))
        ],
        "rejected": [{"view": view, "reason": reason} for view, reason in rejections(fit, data)],
        "left_out_views": views_left_out(data.masked_views),
        "undetermined": [one.description for one in fit.observability.null_directions],
        "halves": _halves(result.split_half),
        "budget": _budget(result.budget),
        "notes": list(result.notes),
        "warnings": list(result.warnings),
        "files": files,
    }


def calibration_entries(calibration: "Calibration") -> dict[str, Any]:
    """Return camera, transforms and target scale, as calibration files have them."""
    transforms = (calibration.camera_from_mount, calibration.holder_from_world)
    return {
        "mount": calibration.mount,
        "camera": camera_to_dict(calibration.camera),
        "transforms": {
            name: transform_document(transform)
            for name, transform in zip(calibration.transform_names, transforms, strict=True)
        },
        "target_scale": float(calibration.target_scale),
    }


def _parameters(joint: "JointFit") -> list[dict[str, Any]]:
    """Return every parameter with its unit, standard deviation and 95 % half width."""
    from ..joint import parameter_estimates

    return [
        {
            "name": one.name,
            "unit": one.unit,
            "value": one.value,
            # Held parameters have none, and so have undetermined ones: `held` tells which.
            "held": one.std is None,
            "std": one.std,
            "half_width_95": one.half_width,
        }
        for one in parameter_estimates(joint)
    ]


def _robot_errors(joint: "JointFit") -> dict[str, Any] | None:
    """Return the estimated standard deviations and models of error; None if not estimated."""
    noise, estimate = joint.noise, joint.noise_estimate
    if noise is None or estimate is None:
        return None
    return {
        "model": str(estimate.name),
        "probabilities": {str(one.name): one.probability for one in estimate.candidates},
        "pixel_std_px": noise.pixel,
        # Where it is not modelled apart, the scatter of points is that of whole views.
        "within_view_std_px": noise.pixel if noise.white_pixel is None else noise.white_pixel,
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


def _budget(budget: "ErrorBudget | None") -> dict[str, Any] | None:
    """Return what the error comes from, the largest cause first; None if not computed."""
    if budget is None:
        return None
    return {
        "total_rms_px": budget.total_rms,
        "causes": [
            {"name": one.name, "rms_px": one.rms, "advice": one.advice} for one in budget.causes
        ],
        # Each of these explains the same smooth error by one number; only measuring can tell.
        "scale_hypotheses": [
            {
                "name": one.name,
                "scale": one.scale,
                "std": one.std,
                "deviance_decrease": one.log_likelihood_ratio,
                "deviance_decrease_by_field": one.field_log_likelihood_ratio,
                "held_out_by_region_rms_px": one.region_rms,
            }
            for one in budget.scale_hypotheses
        ],
        "summary": budget.summary,
    }
