"""Staged, then joint, with the best defaults: what the command line runs."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool

from .calibration import Calibration
from .cameras import AbstractLens, Camera
from .dataset import Dataset, chain_residuals
from .engine import parameter_names
from .fit_result import Rejection
from .joint import JointFit, batch_filter, fit_joint, rehearse
from .staged import StagedFit, fit_staged, kalman_filter, views_to_use

LENS = "opencv4"
"""By default: it predicts unseen views of real sets best (`python -m benchmarks defaults`).

One that does not decentre hides on some of them what the arm does.
"""

WORSE_THAN_STAGED, MUCH_WORSE_THAN_STAGED = 1.5, 5.0
"""Residuals over the staged fit's that are remarkable: of the whole fit, and of the bare chain."""

STEP2 = {"kalman": kalman_filter, "batch": batch_filter}
"""Ways of fitting one camera to all views."""


class CalibrationFit(eqx.Module):
    """A staged fit and the joint fit that it started; the joint one's answers are this one's.

    Attributes:
        staged: the paper's pipeline.
        joint: the joint fit.
    """

    staged: StagedFit
    joint: JointFit

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """What either left out, once and with the first reason: the joint fit saw neither."""
        both = (*self.staged.rejected, *self.joint.rejected)
        return tuple({entry[:2]: entry for entry in reversed(both)}.values())[::-1]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What speaks against the answer: the joint fit's own doubts, and the staged fit's say."""
        return (*self.joint.warnings, *_beside_staged(self))

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.joint, name)


def calibrate(
    data: Dataset,
    lens: str | AbstractLens = LENS,
    *,
    camera: Camera | None = None,
    step2: str = "kalman",
    progress: Callable[[str], None] | None = None,
    **joint_options,
) -> CalibrationFit:
    """Calibrate by the staged pipeline, then by the joint fit without its outliers.

    Args:
        data: at least three views with six visible points each.
        lens: of both fits; the paper's is `"radial"`.
        camera: a camera that is known and held in both.
        step2: `"kalman"`, the paper's filter, or `"batch"`, which is faster on many points.
        progress: told what is being done.
        joint_options: passed on to `fit_joint`.

    Raises:
        ValueError: as `fit_staged` and `fit_joint` do.
    """
    if step2 not in STEP2:
        raise ValueError(f"step2 is one of {', '.join(STEP2)}; found {step2!r}")
    if camera is not None:
        joint_options["fixed"] = ("camera", *joint_options.get("fixed", ()))
    # What is wrong with the data is said before the rehearsal, which cannot be interrupted.
    views_to_use(data, camera)
    with ThreadPoolExecutor(max_workers=1) as background:
        rehearsal = background.submit(rehearse, data, lens, camera, joint_options)
        staged = fit_staged(data, lens, camera=camera, step2=STEP2[step2], progress=progress)
        rehearsal.exception()  # waits; what is wrong with the data the real run will say
    trusted = _seen_only(data, staged.inliers)
    joint = fit_joint(trusted, staged.calibration, progress=progress, **joint_options)
    # The report is on everything that was seen, outliers too.
    # Without the region, as the fits themselves compiled it.
    bare = dataclasses.replace(joint.calibration, region=None)
    everything = chain_residuals(bare, data.observations)
    joint = eqx.tree_at(lambda f: f.residuals, joint, everything)
    return CalibrationFit(staged, joint)


def best_uncorrected(data: Dataset, fit: CalibrationFit) -> Calibration:
    """The chain that predicts best where nothing corrects the robot's error.

    For programs that know transforms alone. It takes the robot's poses as exact, and bends the
    camera and the mount to what the robot does: its hand-eye transform is not where the camera is.
    What the fit left out is left out, and what it held is held; priors are not known here.

    Args:
        data: what the fit was fitted to.
        fit: to correct nothing in.
    """
    start, moved = fit.joint.calibration.uncorrected, set(fit.joint.parameter_names)
    held = tuple(name for name in parameter_names(start) if name not in moved)
    free = tuple(name for name in ("target_scale",) if name in moved)
    used = _seen_only(data, fit.joint.problem.observations.visible)
    return fit_joint(used, start, noise="trusted", fixed=held, free=free).calibration


def _beside_staged(fit: CalibrationFit) -> tuple[str, ...]:
    """Return what the staged fit says against the joint one."""
    joint = fit.joint
    seen = np.asarray(joint.inliers)

    def rms(residuals: Array) -> float:
        return float(np.sqrt(np.mean(np.sum(np.asarray(residuals)[seen] ** 2, axis=-1))))

    staged, whole = rms(fit.staged.residuals), rms(joint.residuals)
    found = []
    if whole > WORSE_THAN_STAGED * staged:
        found.append(f"the joint fit leaves {whole:.2f} px RMS, the staged one {staged:.2f}")
    if joint.calibration.robot_error is not None:
        bare = rms(chain_residuals(joint.calibration.uncorrected, joint.problem.observations))
        if bare > MUCH_WORSE_THAN_STAGED * staged:
            found.append(
                f"without its correction of the robot the chain leaves {bare:.1f} px RMS, the "
                f"staged one {staged:.1f}: the correction holds what belongs elsewhere"
            )
    return tuple(found)


def _seen_only(data: Dataset, these: Bool[Array, "views points"]) -> Dataset:
    return eqx.tree_at(lambda d: d.visible, data, data.visible & these)
