"""Say what limits a calibration, and what to do next, in sentences."""

from collections.abc import Sequence

import numpy as np

from ..calibration_pipeline import CalibrationFit
from ..dataset import Dataset
from ..joint import JointFit
from .tables import ErrorSummary

CAMERA_LIMITED_RATIO = 1.5
"""Largest ratio of the chain's error to the camera's at which the camera is the limiting factor."""

MORE_VIEWS_FACTOR = 2
"""Factor on the number of views that is suggested if the hand-eye transform is too uncertain."""


def hand_eye_half_widths(fit: JointFit) -> tuple[float, float]:
    """Return the largest half widths of the hand-eye transform's 95 % intervals, m and rad.

    For the three coordinates of the translation, then for the three of the rotation; infinite if
    the data do not determine one, NaN if all were fixed.
    """
    mount = fit.calibration.transform_names[0]
    half_widths = []
    for part in ("translation", "rotation"):
        names = [f"{mount}.{part}.{axis}" for axis in "xyz"]
        known = [fit.confidence_half_width(name) for name in names if name in fit.std]
        half_widths.append(max(known, default=float("nan")))
    return half_widths[0], half_widths[1]


def hand_eye_sentence(fit: JointFit) -> str:
    """Return in words how well the hand-eye transform is known."""
    translation, rotation = hand_eye_half_widths(fit)
    name = fit.calibration.transform_names[0]
    if np.isnan(translation) and np.isnan(rotation):
        return f"{name} was held, not estimated."
    if not np.isfinite([translation, rotation]).all():
        return f"{name} is not determined by these views."
    return (
        f"{name} is known to {1e3 * translation:.2g} mm and {np.rad2deg(rotation):.2g} degrees "
        "along its least known axes (95 %)."
    )


def next_steps(fit: CalibrationFit, data: Dataset, rows: Sequence[ErrorSummary]) -> list[str]:
    """Return what limits the result and what would improve it, from the rows of both fits."""
    if not fit.joint.result.converged:
        return ["Look at the rejected views below and correct or remove them, then fit again."]
    sentences = [_limit(fit, rows[1]), _more_views(fit.joint, data)]
    if rows[1].held_out is None:
        sentences.append("Fit again with held-out errors: errors of fitted views are optimistic.")
    return [sentence for sentence in sentences if sentence]


def _limit(fit: CalibrationFit, joint: ErrorSummary) -> str:
    """Return whether the camera or the robot limits the error of the whole chain."""
    floor = float(fit.staged.step2.rms)
    # Errors of fitted views are optimistic, so the held-out ones are used if known.
    held_out = joint.held_out
    rms = joint.reprojection_errors.rms if held_out is None else held_out.errors.rms
    if not np.isfinite(rms):
        return ""
    if rms <= CAMERA_LIMITED_RATIO * floor:
        return (
            f"The camera and the detected points limit the error ({floor:.2f} px of {rms:.2f} px): "
            "sharper pictures or a larger target would help, a better robot would not."
        )
    return (
        "The robot's poses or the target's size limit the error, not the camera "
        f"({floor:.2f} px of {rms:.2f} px): measure the target with a ruler, let the arm settle "
        "before each picture, and calibrate with --diagnose to see the causes one by one."
    )


def _more_views(fit: JointFit, data: Dataset) -> str:
    """Return the benefit of more views: standard deviations fall with the root of their number."""
    half_widths = hand_eye_half_widths(fit)
    if not np.isfinite(half_widths).all():
        return "Add views that differ in direction and in roll about the optical axis."
    used = int(np.asarray(data.visible).any(axis=1).sum())
    translation = 1e3 * half_widths[0]
    return (
        f"With {MORE_VIEWS_FACTOR * used} views of the same kind instead of {used} the hand-eye "
        f"transform would be known to about {translation / np.sqrt(MORE_VIEWS_FACTOR):.2g} mm "
        f"instead of {translation:.2g} mm; sv.choose_views finds better ones."
    )
