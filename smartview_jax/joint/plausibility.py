"""Check whether the result of a joint fit is physically plausible, and return warnings.

A fit that converged with small residuals can still be wrong: residuals show how well the model
follows the data, not whether its parameters are realistic. The result is compared with typical
errors of arms, with the fit without a smooth robot error, and with the accuracy that hand-eye
calibration needs.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ..calibration import BOW, PRINT, Calibration
from ..cameras import Camera, lens_name
from ..data_checks import OTHER_ARM_RATIO, OTHER_ARM_TEXT, mistaken_unit
from ..dataset import MINIMUM_RELIABLE_VIEWS, PoseObservations, distinct_poses, repetition_warnings
from ..engine import TARGET_SCALE, Direction, step_names
from ..geometry import host_matrices, vector_text
from ..robot_errors import nominal_arm
from ..variance import MIN_SHAPE_SIGMAS, TargetScaleEvidence
from .bending import bending_warnings
from .camera_like_errors import camera_like_errors
from .joint_fit import JointFit, half_width
from .parameter_estimates import whole_errors_by_parameters

MAX_CORRECTION_TRANSLATION, MAX_CORRECTION_ROTATION = 5e-3, float(np.deg2rad(1.5))
"""The largest plausible smooth correction of a reported pose, m and rad."""

MAX_PRIOR_SIGMAS = 3.0
"""Distance of log(sigma) from its prior, in standard deviations, that is implausible."""

MAX_TRANSLATION_HALF_WIDTH, MAX_ROTATION_HALF_WIDTH = 5e-3, float(np.deg2rad(0.5))
"""The largest acceptable half width of the hand-eye transform's 95 % intervals, m and rad."""

MAX_MOUNT_SHIFT_SIGMAS = 2.0
"""The largest shift of the mount by the robot correction without warning, standard deviations."""

MAX_EFFECTIVE_TO_WHITE_SIGMA = 5.0
"""The ratio of effective to white pixel sigma above which the camera or target model is wrong."""

MAX_CHAIN_RMS = 20.0
"""The RMS residual of the chain, px, above which poses and pictures do not belong together."""

MIN_SCALE_PROBABILITY, MAX_SCALE_PROBABILITY = 0.05, 0.95
"""Probabilities of a wrong target size above which a warning mentions the estimated size, and above
which it mentions only this size."""

CONSEQUENCE = "correct first the values that the pictures contradict, which may be why"
"""The advice on a size that may follow from values that the user stated wrongly."""

MAX_PRINCIPAL_POINT_OFFSET = 0.15
"""Distance of the principal point from the middle of the picture, over its width or height, above
which a warning asks whether the pixels are of these pictures. Lenses are mounted to within some
hundredths; half of a cropped picture is a quarter off."""

MIN_OFFSET_SIGMAS = 3.0
"""Smallest excess over it, in standard deviations, with which it is named."""

RICHER_LENSES = {
    "pinhole": "opencv4",
    "radial": "opencv4",
    "weng": "opencv5",
    "opencv4": "opencv5",
    "opencv5": "opencv8",
}
"""The lens to try next, by the fitted lens."""

OWN_VARIANCE_SHARE = 0.5
"""The fraction of a variance above which a warning names its cause: the last joint's zero, or
distortion that the lens model does not describe."""


def plausibility_warnings(
    fit: JointFit, contradicted_values: Sequence[str] = ()
) -> tuple[str, ...]:
    """Return the reasons to doubt the result of a joint fit, a sentence each.

    They are in the order in which a person should look at them: a result that is none, then causes
    of a wrong result that can be measured or changed (stated values, the target, the lens, the
    robot), then an uncertainty that is stated but large.

    Args:
        fit: the fit to judge.
        contradicted_values: warnings about values that the user stated (`held_value_test`).
    """
    warnings = [] if fit.result.converged else [fit.result.message]
    has_pixels = not isinstance(fit.problem.observations, PoseObservations)
    warnings += _chain_warnings(fit) if has_pixels else []
    warnings += [
        f"the data do not determine: {direction.description}; {_advice(direction, fit.calibration)}"
        for direction in fit.observability.null_directions
    ]
    warnings += principal_point_warnings(fit.calibration.camera, fit.std, "camera")
    # Before the target: its size is found wrong if a known focal length is.
    warnings += contradicted_values
    warnings += _scale_warnings(fit, bool(contradicted_values)) + _shape_warnings(fit)
    of_lens = _lens_warnings(fit)
    # Where the lens is not named as the cause, the disagreement is the only sign of one.
    warnings += of_lens or (_disagreement_warnings(fit) if has_pixels else [])
    warnings += _robot_warnings(fit, bool(contradicted_values))
    warnings += bending_warnings(fit)
    warnings += _mount_warnings(fit)
    warnings += repetition_warnings(fit.rejected)
    # Several pictures from one pose have no more information on the robot than one.
    poses = host_matrices(fit.problem.observations.base_from_tool)
    used_views = len(distinct_poses(poses[fit.used_views]))
    if used_views < MINIMUM_RELIABLE_VIEWS:
        warnings.append(
            f"{used_views} views are few: no figure is reliable with fewer than "
            f"{MINIMUM_RELIABLE_VIEWS}"
        )
    return tuple(warnings)


def _advice(direction: Direction, calibration: Calibration) -> str:
    """Return advice on how to determine an undetermined direction."""
    mount = calibration.transform_names[0]
    names = [name for name, _ in direction.components]
    name = next((name for name in names if name.startswith(f"{mount}.")), names[0])
    path, start = name.split("."), ""
    if path[0] in calibration.transform_names:
        start = f"start={{'{path[0]}': ...}} and "
    prior = (
        f"priors={{'{name}': Prior(std=...)}}"
        if "rotation" in path
        else f"priors={{'{name}': Prior(mean=..., std=...)}}"
    )
    return (
        "it keeps the value of the start. Rotate the robot about another axis, or state the value: "
        f"{start}fixed=('{name}',), or {prior}"
    )


def _chain_warnings(fit: JointFit) -> list[str]:
    """Return a warning if poses and pictures do not belong together."""
    inliers = np.asarray(fit.inliers)
    # NumPy's sum over an axis of two entries takes four times as long.
    squares = np.einsum("vpk,vpk->vp", fit.residuals, fit.residuals)
    rms = float(np.sqrt(np.mean(squares[inliers]))) if inliers.any() else np.nan
    if rms <= MAX_CHAIN_RMS:
        return []
    # NaN gives a warning too.
    return [
        f"the chain leaves residuals of {rms:.0f} px: poses and pictures do not belong together; "
        f"mirrored pictures, a wrong pose convention, or mispaired views?"
    ]


def principal_point_warnings(camera: Camera, std: Mapping[str, float], path: str) -> list[str]:
    """Return a warning if the principal point is far from the middle of the picture.

    So it is where the pixels were measured in pictures of another size, or in cropped ones.

    Args:
        camera: as found.
        std: standard deviations of the parameters that were fitted, by name.
        path: path of the camera's parameters, such as `camera`.
    """
    names = [f"{path}.{name}" for name in ("u0", "v0")]
    # A camera that was given is judged by its own test.
    if not set(names) <= set(std):
        return []
    size = np.array(camera.image_size, dtype=float)
    point = np.array([float(camera.u0), float(camera.v0)])
    # The centre of the first pixel is (0, 0).
    offset = np.abs(point - 0.5 * (size - 1.0))
    excess = offset - MAX_PRINCIPAL_POINT_OFFSET * size
    if not (excess > MIN_OFFSET_SIGMAS * np.array([std[name] for name in names])).any():
        return []
    width, height = camera.image_size
    owner = path.removesuffix(".camera") + ": " if path != "camera" else ""
    return [
        f"{owner}the principal point {vector_text(point, 0)} px is far from the middle of pictures "
        f"of {width} x {height} px: were the pixels measured in pictures of another size, or in "
        "cropped ones? State the size of the pictures in which the target was detected; if these "
        "are parts of larger ones, or the lens is shifted, this is right"
    ]


def _disagreement_warnings(fit: JointFit) -> list[str]:
    """Return a warning if views disagree by much more than the noise within a view."""
    noise = fit.noise
    if (
        noise is None
        or not noise.white_pixel
        or noise.pixel <= MAX_EFFECTIVE_TO_WHITE_SIGMA * noise.white_pixel
    ):
        return []
    return [
        f"views disagree by {noise.pixel / noise.white_pixel:.0f} times the pixel noise within "
        f"a view: the model of the lens, or of the target, is wrong, or the camera moved while it "
        "took the pictures (rolling shutter): let it stand still"
    ]


def _lens_warnings(fit: JointFit) -> list[str]:
    """Return a warning if unmodelled distortion dominates the uncertainty of the result."""
    estimate = fit.noise_estimate
    if estimate is None or estimate.lens is None:
        return []
    calibration, lens = fit.calibration, estimate.lens
    # The lens's own coefficients do not count: they always change with an additional term.
    names = ("camera.alpha", "camera.u0", "camera.v0", f"{calibration.transform_names[0]}.")
    variances = zip(estimate.parameter_names, np.diagonal(lens.covariance), strict=True)
    changes = any(
        variance > OWN_VARIANCE_SHARE * fit.std[name] ** 2 > 0.0
        for name, variance in variances
        if name.startswith(names) and name in fit.std
    )
    if lens.probability < MAX_SCALE_PROBABILITY or not changes:
        return []
    kind = lens_name(calibration.camera.lens)
    richer = RICHER_LENSES.get(kind)
    advice = f"try lens='{richer}', and check" if richer else "check"
    return [
        f"distortion of {lens.rms:.2g} px RMS is not described by the {kind} lens: {advice} "
        "the target and the detections"
    ]


def _shape_warnings(fit: JointFit) -> list[str]:
    """Return warnings about a target that bows or is stretched, if that matters for the mount."""
    noise_estimate = fit.noise_estimate
    if noise_estimate is None or noise_estimate.target_shape is None:
        return []
    estimate = noise_estimate.target_shape
    observations = fit.problem.seen_points
    bow, std = estimate.bow(np.asarray(observations.points)[np.asarray(observations.visible)])
    stretch, stretch_std = estimate.stretch
    longer, other = ("x", "y") if stretch > 0.0 else ("y", "x")
    mount = f"{fit.calibration.transform_names[0]}."
    names = [name for name in fit.parameter_names if name.startswith(mount)]
    rows = [noise_estimate.parameter_names.index(name) for name in names]
    stds = np.array([fit.std[name] for name in names])
    kinds = (
        (
            bow > MIN_SHAPE_SIGMAS * std,
            BOW,
            f"the target bows by {1e3 * bow:.2f} +- {1e3 * std:.2f} mm, which is corrected; "
            "taken as flat",
        ),
        (
            estimate.is_stretched,
            PRINT,
            f"the target is stretched by {100.0 * abs(stretch):.2f} +- {100.0 * stretch_std:.2f} % "
            f"along its {longer} compared with its {other}, which is corrected; taken as stated",
        ),
    )
    warnings = []
    for is_certain, part, text in kinds:
        shift = estimate.by_shape[rows, part] @ np.asarray(estimate.shape.coefficients)[part]
        if is_certain and (np.abs(shift) > stds).any():
            distance = 1e3 * np.linalg.norm(shift[:3])
            warnings.append(f"{text}, it would shift {mount[:-1]} by {distance:.2f} mm")
    return warnings


def _scale_warnings(fit: JointFit, values_are_wrong: bool) -> list[str]:
    """Return warnings about the stated size of the target.

    Where the pictures contradict values that the user stated, a wrong size may follow from these.
    """
    scale = None if fit.noise_estimate is None else fit.noise_estimate.target_scale
    if scale is None or scale.probability < MIN_SCALE_PROBABILITY:
        return []
    size = f"of its stated size (probability {scale.probability:.2f})"
    by_joints = fit.problem.observations.joints is not None
    if scale.probability > MAX_SCALE_PROBABILITY:
        # The parameter is the logarithm: its standard deviation is relative.
        value = float(fit.calibration.target_scale)
        std = value * fit.std[TARGET_SCALE]
        advice = CONSEQUENCE if values_are_wrong else _size_advice(value, std, by_joints)
        return [f"the target is {value:.4f} +- {std:.4f} {size}; this size is used: {advice}"]
    advice = CONSEQUENCE if values_are_wrong else _size_advice(scale.scale, scale.std, by_joints)
    text = f"the target may be {scale.scale:.4f} +- {scale.std:.4f} {size}: {advice}"
    return [text + _mount_by_size(fit, scale)]


def _size_advice(scale: float, std: float, by_joints: bool) -> str:
    """Return what to do about a target of another size than stated: a unit may be mistaken.

    Where joints gave the poses, the arm's description may be of another one.
    """
    # The camera's motion is measured in the target's size.
    unit = mistaken_unit(1.0 / scale, MAX_PRIOR_SIGMAS * std / scale)
    if by_joints and not 1.0 / OTHER_ARM_RATIO < scale < OTHER_ARM_RATIO:
        return f"measure it{f'; {unit}?' if unit else ''}; {OTHER_ARM_TEXT}"
    return f"measure it; {unit}?" if unit else "measure it"


def _mount_by_size(fit: JointFit, scale: TargetScaleEvidence) -> str:
    """Return the position of the mount for both sizes of the target; empty if it is held."""
    mount = fit.calibration.transform_names[0]
    names = [f"{mount}.translation.{axis}" for axis in "xyz"]
    if not {TARGET_SCALE, *names} <= set(fit.parameter_names):
        return ""
    rows = [fit.parameter_names.index(name) for name in names]
    size = fit.parameter_names.index(TARGET_SCALE)
    # Given the size, all other parameters follow by regression.
    by_log_size = fit.covariance[rows, size] / fit.covariance[size, size]
    position = host_matrices(fit.calibration.camera_from_mount)[:3, 3]
    fitted_log_size = np.log(float(fit.calibration.target_scale))
    stated, other = (
        vector_text(1e3 * (position + by_log_size * (log_size - fitted_log_size)), 2)
        for log_size in (0.0, np.log(scale.scale))
    )
    return f"; {mount} is {stated} mm for the stated size, {other} mm for this one"


def _robot_warnings(fit: JointFit, values_are_wrong: bool) -> list[str]:
    """Return warnings about the robot's errors: implausibly large sigmas or corrections.

    Where the pictures contradict values that the user stated, the camera is wrong in all views
    alike, and no warning says that it changes.
    """
    if fit.noise_estimate is None or fit.noise is None:
        return []
    noise, prior, field = fit.noise, fit.noise_estimate.robot_prior, fit.calibration.field
    # Standard deviations of the variance components, in the order of the prior's medians.
    sigmas = np.array([*fit.noise_estimate.largest_pose_sigmas, *noise.field])
    along = "" if fit.noise_estimate.directions is None else " in their worst direction"
    names = [f"{part} of reported poses{along}" for part in ("translation", "rotation")]
    names += [] if field is None else field.group_names
    medians, log_stds = prior.medians(field), prior.log_stds(field)
    # Log-normal prior: implausible is log(sigma / median) > MAX_PRIOR_SIGMAS log_std.
    implausible = np.log(sigmas / medians) > MAX_PRIOR_SIGMAS * log_stds
    factors, units = [1e3, float(np.rad2deg(1.0))], [" mm", " degrees"]
    factors += [1.0] * len(sigmas[2:])
    units += [""] * len(sigmas[2:])
    warnings = [
        f"implausibly large error of the robot: {names[k]} {factors[k] * sigmas[k]:.2g}{units[k]}, "
        f"usually {factors[k] * medians[k]:.1g}{units[k]}"
        for k in np.flatnonzero(implausible)
    ]
    if warnings and not values_are_wrong:
        warnings = camera_like_errors(fit) + warnings
    if fit.calibration.robot_error is not None:
        twists = np.asarray(fit.field_corrections)
        # The mean correction is removed, because it cannot be separated from the mount.
        centred = twists[fit.used_views] - twists[fit.used_views].mean(axis=0)
        translation, rotation = (
            np.linalg.norm(part, axis=1).max() for part in (centred[:, :3], centred[:, 3:])
        )
        if translation > MAX_CORRECTION_TRANSLATION or rotation > MAX_CORRECTION_ROTATION:
            warnings.append(
                f"implausibly large correction of the robot: up to {1e3 * translation:.1f} mm and "
                f"{np.rad2deg(rotation):.2f} degrees"
            )
    return warnings


def _mount_warnings(fit: JointFit) -> list[str]:
    """Return warnings about the hand-eye transform: wide intervals, or a large shift."""
    warnings, coarse = _wide_mount_intervals(fit)
    # A direction that is weak relative to others may still be determined well enough, so it is
    # reported only if it contains a coarse component.
    warnings += [
        f"the data hardly determine: {direction.description}"
        for direction in fit.observability.weak_directions
        if coarse & {name for name, _ in direction.components}
    ]
    return warnings + _mount_shift_warnings(fit)


def _wide_mount_intervals(fit: JointFit) -> tuple[list[str], set[str]]:
    """Return warnings about wide intervals of the hand-eye transform, and its coarse parameters.

    Parameters that the last joint's zero makes uncertain have a warning of their own, and are not
    counted as coarse.
    """
    mount = fit.calibration.transform_names[0]
    warnings, coarse_names = [], set()
    undetermined = {
        name for direction in fit.observability.null_directions for name, _ in direction.components
    }
    stds, freedoms = fit.std, fit.degrees_of_freedom
    last_joint_held = _half_widths_with_last_joint_held(fit)
    for part, limit, unit, scale in (
        ("translation", MAX_TRANSLATION_HALF_WIDTH, "mm", 1e3),
        ("rotation", MAX_ROTATION_HALF_WIDTH, "degrees", float(np.rad2deg(1.0))),
    ):
        names = [n for n in fit.parameter_names if n.startswith(f"{mount}.{part}.")]
        # Not by the fit's method, because Equinox copies a module for each call of a method.
        half_widths = {name: half_width(stds[name], freedoms[name]) for name in names}
        # Undetermined parameters are reported with their direction.
        coarse = {
            name: width
            for name, width in half_widths.items()
            if not width <= limit and name not in undetermined
        }
        # An error of the last joint's zero is equivalent to a rotation of the mount.
        by_last_joint = {
            name
            for name in coarse
            if last_joint_held.get(name, np.inf) ** 2 < OWN_VARIANCE_SHARE * coarse[name] ** 2
        }
        if by_last_joint:
            worst = max(by_last_joint, key=lambda name: coarse[name])
            warnings.append(
                f"{worst} is known to +- {scale * coarse[worst]:.3g} {unit} only, because the zero "
                "of the last joint is equivalent to a rotation of the mount: no view can separate "
                "them, but both together are known to "
                f"+- {scale * last_joint_held[worst]:.3g} {unit}"
            )
            coarse = {name: width for name, width in coarse.items() if name not in by_last_joint}
        coarse_names |= set(coarse)
        if coarse:
            worst = max(coarse, key=lambda name: coarse[name])
            warnings.append(
                f"{worst} is known to +- {scale * coarse[worst]:.3g} {unit} only (95 %): "
                f"take more views, turned about more axes"
            )
    return warnings, coarse_names


def _mount_shift_warnings(fit: JointFit) -> list[str]:
    """Return a warning if the correction of the robot moves the hand-eye transform far."""
    if fit.noise_estimate is None or fit.noise_estimate.mount_displacement is None:
        return []
    shift, mount = (
        np.array(fit.noise_estimate.mount_displacement),
        fit.calibration.transform_names[0],
    )
    names = step_names(mount)
    # Only parameters that are free and determined have a finite std.
    determined = [k for k, name in enumerate(names) if np.isfinite(fit.std.get(name, np.inf))]
    shift_in_stds = np.array([abs(shift[k]) / fit.std[names[k]] for k in determined])
    if not len(shift_in_stds) or not shift_in_stds.max() > MAX_MOUNT_SHIFT_SIGMAS:
        return []
    return [
        f"correcting the robot moves {mount} by {1e3 * np.linalg.norm(shift[:3]):.1f} mm "
        f"and {np.rad2deg(np.linalg.norm(shift[3:])):.2f} degrees, "
        f"{shift_in_stds.max():.0f} standard deviations"
    ]


def _half_widths_with_last_joint_held(fit: JointFit) -> dict[str, float]:
    """Return the half widths of the mount's 95 % intervals if the last joint's errors were known.

    An error of the last joint's zero rotates everything after it, as the hand-eye transform does:
    no view can separate the two. Only their combination moves the camera. Empty without free errors
    of an arm's last joint.
    """
    arm = nominal_arm(fit.calibration.field)
    if arm is None:
        return {}
    names = fit.parameter_names
    mount = f"{fit.calibration.transform_names[0]}."
    known = _errors_of_joint(fit, str(arm.joint_count))
    wanted = [k for k, name in enumerate(names) if name.startswith(mount)]
    if not len(known) or not wanted:
        return {}
    covariance = np.asarray(fit.covariance)
    # Cov(a | b) = P_aa - P_ab P_bb^-1 P_ba
    across = covariance[wanted] @ known.T
    explained = across @ np.linalg.pinv(known @ covariance @ known.T, hermitian=True) @ across.T
    conditional = np.diagonal(covariance[np.ix_(wanted, wanted)] - explained).clip(0.0)
    freedom = fit.degrees_of_freedom
    return {
        names[k]: half_width(float(np.sqrt(variance)), freedom[names[k]])
        for k, variance in zip(wanted, conditional, strict=True)
    }


def _errors_of_joint(fit: JointFit, joint: str) -> Float[np.ndarray, "errors parameters"]:
    """Return the derivatives of the fitted errors of a joint by the fit's parameters."""
    names, by_parameters = whole_errors_by_parameters(fit)
    of_joint = by_parameters[[name.split(".")[-1] == joint for name in names]]
    return of_joint[of_joint.any(axis=1)]
