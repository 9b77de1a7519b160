"""Check whether a joint fit's answer is physically plausible, and state the doubts in words.

A fit that converged with small residuals can still be wrong: residuals show how well a model can
follow the data, not whether arms, targets and mounts have such values. The answer is compared with
typical errors of arms, with the fit without a smooth robot error, and with the accuracy that
hand-eye calibration needs.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float

from ..compilation import compiled
from ..dataset import Observations
from ..robot_errors import RobotError
from ..variance import DECIDED, MINIMUM_RELIABLE_VIEWS, SCALE

if TYPE_CHECKING:
    from .fit import JointFit

LARGEST_TRANSLATION, LARGEST_ROTATION = 5e-3, float(np.deg2rad(1.5))
"""The largest plausible smooth correction of a reported pose, m and rad."""

UNUSUAL = 3.0
"""The number of prior standard deviations beyond which the size of an error is unusual."""

COARSE_TRANSLATION, COARSE_ROTATION = 5e-3, float(np.deg2rad(0.5))
"""The half width of the hand-eye transform's 95 % intervals that is too coarse, m and rad."""

MOVED = 2.0
"""The change of the mount by the robot correction that gives a warning, in standard deviations."""

SCATTERED = 5.0
"""The ratio of effective to white pixel sigma above which the camera or target model is wrong."""

FAR_OFF_RMS = 20.0
"""The RMS residual of the chain, px, that no lens and no arm explains."""

POSSIBLE = 0.05
"""The probability of another target size from which a warning mentions it."""


def doubts(fit: "JointFit") -> tuple[str, ...]:
    """Return the reasons to doubt a joint fit's answer, a sentence each; empty if there are none.

    Args:
        fit: the fit to judge.
    """
    found = [] if fit.result.converged else [fit.result.message]
    found += _of_residuals(fit)
    found += _of_target(fit)
    found += _of_robot(fit)
    found += _of_mount(fit)
    found += [f"the data do not tell: {one.words}" for one in fit.observability.null]
    used = int((np.asarray(fit.inliers).sum(axis=1) > 0).sum())
    if used < MINIMUM_RELIABLE_VIEWS:
        found.append(
            f"{used} views are few: no figure is reliable with fewer than {MINIMUM_RELIABLE_VIEWS}"
        )
    return tuple(found)


def _of_residuals(fit: "JointFit") -> list[str]:
    """Return doubts about the residuals: a chain that does not fit, or views that disagree."""
    seen = np.asarray(fit.inliers)
    squares = np.sum(np.asarray(fit.residuals) ** 2, axis=-1)
    # A negated comparison below, so that NaN gives a warning too.
    rms = float(np.sqrt(np.mean(squares[seen]))) if seen.any() else np.nan
    found = []
    if not rms <= FAR_OFF_RMS:
        found.append(
            f"the chain leaves {rms:.0f} px RMS: poses and pictures do not belong together; "
            f"mirrored pictures, another convention of the poses, or mispaired views?"
        )
    noise = fit.noise
    if noise is not None and noise.white_pixel and noise.pixel > SCATTERED * noise.white_pixel:
        found.append(
            f"views disagree by {noise.pixel / noise.white_pixel:.0f} times what pixels scatter "
            f"within a view: the lens, or the target's points, are not as modelled"
        )
    return found


def _of_target(fit: "JointFit") -> list[str]:
    """Return doubts about the stated size of the target."""
    scale = None if fit.estimate is None else fit.estimate.scale
    if scale is None or scale.probability < POSSIBLE:
        return []
    chance = f"of its stated size (probability {scale.probability:.2f})"
    if scale.probability > DECIDED:
        size, std = float(fit.calibration.target_scale), fit.std[SCALE]
        return [f"the target is {size:.4f} +- {std:.4f} {chance}, and taken so: measure it"]
    return [f"the target may be {scale.size:.4f} +- {scale.std:.4f} {chance}: measure it"]


def _of_robot(fit: "JointFit") -> list[str]:
    """Return doubts about the robot's errors: unusually large components or corrections."""
    if fit.estimate is None or fit.noise is None:
        return []
    noise, prior, field = fit.noise, fit.estimate.prior, fit.calibration.field
    # The variance components, in the order of the prior's medians and spreads.
    sizes = np.array([noise.translation, noise.rotation, *noise.field])
    names = ["translation of reported poses", "rotation of reported poses"]
    names += [] if field is None else [name for name, _ in field.groups]
    medians, spreads = prior.medians(field), prior.spreads(field)
    # Log-normal prior: unusual is log(size / median) > UNUSUAL spreads.
    beyond = np.log(sizes / medians) > UNUSUAL * spreads
    found = [
        f"errors of the robot are larger than arms have: {names[k]} {sizes[k]:.2g}, "
        f"usually {medians[k]:.1g}"
        for k in np.flatnonzero(beyond)
    ]
    error = fit.calibration.robot_error
    if error is not None:
        twists = np.asarray(_corrections(error, fit.problem.observations))
        seen = np.asarray(fit.inliers).any(axis=1)
        # The mean correction is removed: it cannot be separated from the mount, and is no error of
        # the arm.
        off = twists[seen] - twists[seen].mean(axis=0)
        shift, turn = (np.linalg.norm(part, axis=1).max() for part in (off[:, :3], off[:, 3:]))
        if shift > LARGEST_TRANSLATION or turn > LARGEST_ROTATION:
            found.append(
                f"the robot is corrected by up to {1e3 * shift:.1f} mm and "
                f"{np.rad2deg(turn):.2f} degrees, which is more than arms err"
            )
    return found


@compiled
def _corrections(error: RobotError, seen: Observations) -> Float[Array, "views 6"]:
    """Return the twists at the tool from the reported to the corrected poses."""
    return (seen.base_from_tool.inverse() @ error.true_pose(seen.command)).log()


def _of_mount(fit: "JointFit") -> list[str]:
    """Return doubts about the hand-eye transform: wide intervals, or a large robot correction."""
    mount = fit.calibration.transform_names[0]
    found, vague = [], set()
    for part, limit, unit, times in (
        ("translation", COARSE_TRANSLATION, "mm", 1e3),
        ("rotation", COARSE_ROTATION, "degrees", float(np.rad2deg(1.0))),
    ):
        names = [n for n in fit.parameter_names if n.startswith(f"{mount}.{part}.")]
        widths = {name: fit.margin(name) for name in names}
        coarse = {name: width for name, width in widths.items() if not width <= limit}
        vague |= set(coarse)
        if coarse:
            worst = max(coarse, key=lambda name: coarse[name])
            found.append(
                f"{worst} is known to +- {times * coarse[worst]:.3g} {unit} only (95 %): "
                f"take more views, turned about more axes"
            )
    # A direction that is weak relative to others may be determined well enough in absolute terms:
    # report it only where it contains a coarse component.
    found += [
        f"the data hardly tell: {one.words}"
        for one in fit.observability.weak
        if vague & {name for name, _ in one.components}
    ]
    if fit.estimate is not None and fit.estimate.mount_shift is not None:
        shift = np.array(fit.estimate.mount_shift)
        names = [f"{mount}.{p}.{a}" for p in ("translation", "rotation") for a in "xyz"]
        known = [k for k, name in enumerate(names) if np.isfinite(fit.std.get(name, np.inf))]
        times = np.array([abs(shift[k]) / fit.std[names[k]] for k in known])
        if len(times) and times.max() > MOVED:
            found.append(
                f"correcting the robot moves {mount} by {1e3 * np.linalg.norm(shift[:3]):.1f} mm "
                f"and {np.rad2deg(np.linalg.norm(shift[3:])):.2f} degrees, {times.max():.0f} "
                f"standard deviations"
            )
    return found
