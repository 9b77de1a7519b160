"""Format the result of a joint fit as text, for `print(fit)` and for notebooks."""

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..calibration import Calibration
from ..cameras import lens_name
from ..geometry import TransformForm, host_matrices, transform_forms
from .parameter_estimates import ParameterEstimate, parameter_estimates

if TYPE_CHECKING:
    from .joint_fit import JointFit


def fit_line(fit: "JointFit") -> str:
    """Return the outcome of a fit in one line."""
    return f"{fit.described}, {outcome(fit)}"


def outcome(fit: "JointFit") -> str:
    """Return whether a fit converged, in words."""
    return "converged" if fit.result.converged else f"not converged: {fit.result.message}"


def points_and_residual(fit: "JointFit") -> str:
    """Return the number of points and views that the fit used, and the size of their residuals.

    It is not called RMS: the RMS of `evaluation.reprojection_errors` and of all tables includes
    points that the fit left out as gross errors.
    """
    visible = np.asarray(fit.problem.observations.visible)
    squares = np.sum(np.asarray(fit.residuals) ** 2, axis=-1)[visible]
    rms = float(np.sqrt(squares.mean())) if squares.size else float("nan")
    return (
        f"joint fit of {visible.sum()} points in {visible.any(axis=1).sum()} views, "
        f"residuals of {rms:.3g} px"
    )


def fit_text(
    fit: "JointFit", warnings: Sequence[str], forms: bool = True, line: str | None = None
) -> str:
    """Return camera, transforms and target with their 95 % intervals, the noise and the warnings.

    Args:
        fit: the fit.
        warnings: reasons to doubt the result, a sentence each.
        forms: whether to begin with the hand-eye transform in the forms of other programs.
        line: the first line; by default `fit_line`.
    """
    lines = [fit_line(fit) if line is None else line]
    for name, group in hand_eye_forms(fit) if forms else ():
        lines.append(name)
        for label, text in group:
            lines += [f"  {label}:", *(f"    {row}" for row in text.splitlines())]
    for heading, rows in estimate_groups(fit):
        lines.append(heading)
        width = 2 + max(len(label) for label, _ in rows)
        lines += [f"  {label:{width}}{text}" for label, text in rows]
    lines.append(fit.described_noise)
    lines += [f"warning: {text}" for text in warnings]
    return "\n".join(lines)


def hand_eye_forms(fit: "JointFit") -> list[tuple[str, list[TransformForm]]]:
    """Return the hand-eye transform and its inverse by name, in the forms of other programs."""
    return calibration_forms(fit.calibration, fit.pose_format)


def calibration_forms(
    calibration: Calibration, pose_format: str | None = None
) -> list[tuple[str, list[TransformForm]]]:
    """Return a calibration's hand-eye transform and its inverse, as `hand_eye_forms` does."""
    name = calibration.transform_names[0]
    target, source = name.split("_from_")
    matrix = host_matrices(calibration.camera_from_mount)
    if not np.isfinite(matrix).all():
        return []
    return [
        (name, transform_forms(matrix, pose_format)),
        (f"{source}_from_{target}", transform_forms(np.linalg.inv(matrix), pose_format)),
    ]


def fit_html(fit: "JointFit", warnings: Sequence[str]) -> str:
    """Return the same as `fit_text`, as a table in HTML for notebooks."""
    rows = []
    for name, forms in hand_eye_forms(fit):
        rows.append(f"<tr><th colspan='2' style='text-align:left'>{html.escape(name)}</th></tr>")
        rows += [
            f"<tr><td>{html.escape(label)}</td><td style='text-align:left'>"
            f"<pre style='margin:0'>{html.escape(text)}</pre></td></tr>"
            for label, text in forms
        ]
    for heading, group in estimate_groups(fit):
        rows.append(f"<tr><th colspan='2' style='text-align:left'>{html.escape(heading)}</th></tr>")
        rows += [
            f"<tr><td>{html.escape(label)}</td><td style='text-align:right'>{html.escape(text)}"
            "</td></tr>"
            for label, text in group
        ]
    texts = [fit.described_noise, *(f"warning: {text}" for text in warnings)]
    remarks = "".join(f"<p>{html.escape(text)}</p>" for text in texts)
    return f"<p>{html.escape(fit_line(fit))}</p><table>{''.join(rows)}</table>{remarks}"


def estimate_groups(fit: "JointFit") -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the parameters under headings: camera, each transform, and the rest.

    Every parameter is a label and a text with its value, 95 % interval and unit.
    """
    estimates = parameter_estimates(fit)
    groups = [
        (heading, [estimate for estimate in estimates if estimate.name.startswith(f"{prefix}.")])
        for prefix, heading in _headings(fit.calibration)
        if fit.fits_camera or prefix != "camera"
    ]
    arm = [estimate for estimate in estimates if estimate.name.startswith("robot_error.")]
    scale = [
        estimate
        for estimate in estimates
        if estimate.name == "target_scale" and estimate.std is not None
    ]
    # Only significant coefficients of the shape are listed.
    shape = [
        estimate
        for estimate in estimates
        if estimate.name.startswith("target_shape.")
        and estimate.half_width is not None
        and abs(estimate.value) > estimate.half_width
    ]
    groups += [("arm (+- 95 %)", arm), ("target (+- 95 %)", scale + shape)]
    return [(heading, list(map(_label_and_text, group))) for heading, group in groups if group]


def _headings(calibration: Calibration) -> list[tuple[str, str]]:
    """Return the beginning of the names in each group, and its heading."""
    camera = calibration.camera
    width, height = camera.image_size
    lens = lens_name(camera.lens)
    transforms = [(name, f"{name} (+- 95 %)") for name in calibration.transforms]
    return [("camera", f"camera, {lens}, {width} x {height} px (+- 95 %)"), *transforms]


def _label_and_text(estimate: ParameterEstimate) -> tuple[str, str]:
    """Return the last part of a parameter's name, and its value with unit and interval."""
    # Rotation vector and translation have the same axes, so the label distinguishes them.
    parts = estimate.name.split(".")
    label = f"turn {parts[-1]}" if parts[-2:-1] == ["rotation"] else parts[-1]
    if parts[0] == "robot_error":
        label = ".".join(parts[1:])
    if estimate.name == "target_scale":
        label = "scale"
    if estimate.half_width is None:
        return label, f"{_rounded(estimate.value, None)} {estimate.unit} (held)".replace("  ", " ")
    if not np.isfinite(estimate.half_width):
        return label, f"{_rounded(estimate.value, None)} {estimate.unit} (not determined)"
    # Both with the significant digits of the interval.
    digits = estimate.half_width
    text = f"{_rounded(estimate.value, digits)} +- {_rounded(digits, digits)} {estimate.unit}"
    return label, text.rstrip()


def _rounded(value: float, half_width: float | None) -> str:
    """Return a number to two digits of its interval's half width; to six digits without one."""
    if half_width is None or not half_width > 0.0:
        return f"{value:.6g}"
    decimals = max(0, 1 - int(np.floor(np.log10(half_width))))
    return f"{value:.{decimals}f}"


def noise_text(fit: "JointFit") -> str:
    """Return the standard deviations of pixels and poses in words."""
    text = f"pixels +- {fit.pixel_sigma:.2g} px"
    if fit.noise is not None and fit.noise.white_pixel is not None:
        text += f" between views, {fit.noise.white_pixel:.2g} px within one"
    text = f"{text}; {robot_noise_text(fit)}"
    return text if fit.sensor is None else f"{text}\ndepth sensor: {fit.sensor.described}"


def robot_noise_text(fit: "JointFit") -> str:
    """Return the standard deviations of the robot's poses in words."""
    if fit.noise is None:
        return "the robot's poses are trusted"
    text = (
        f"reported poses +- {1e3 * fit.noise.translation:.2g} mm, "
        f"{np.rad2deg(fit.noise.rotation):.2g} deg"
    )
    if fit.noise_estimate is not None:
        if fit.noise_estimate.directions is not None:
            translation, rotation = fit.noise_estimate.largest_pose_sigmas
            text += (
                f" on average over their axes, {1e3 * translation:.2g} mm and "
                f"{np.rad2deg(rotation):.2g} deg in their worst direction"
            )
        text += f"; model of the robot's error: {fit.noise_estimate.name}"
    return text
