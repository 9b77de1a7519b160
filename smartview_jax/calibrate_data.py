"""Calibrate by the staged pipeline, then by the joint fit, with the command line's defaults."""

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
"""The default lens model: it predicts unseen views of real data sets best.

The command `python -m benchmarks defaults` shows it. On some of these data sets a lens without
decentring distortion conceals errors of the arm.
"""

WORSE_THAN_STAGED, MUCH_WORSE_THAN_STAGED = 1.5, 5.0
"""The ratios of joint to staged residual RMS above which a warning is given.

The first applies to the whole joint fit, the second to its chain without the robot correction.
"""

STEP2 = {"kalman": kalman_filter, "batch": batch_filter}
"""The methods, by name, that fit one camera to all views."""


class CalibrationFit(eqx.Module):
    """A staged fit and the joint fit started from it; other attributes are those of the joint fit.

    Attributes:
        staged: the fit by the paper's pipeline.
        joint: the joint fit.
    """

    staged: StagedFit
    joint: JointFit

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """The observations that either fit left out, each once and with the first reason.

        The joint fit did not use what the staged fit had left out.
        """
        both = (*self.staged.rejected, *self.joint.rejected)
        return tuple({entry[:2]: entry for entry in reversed(both)}.values())[::-1]

    @property
    def warnings(self) -> tuple[str, ...]:
        """The doubts about the answer: the joint fit's own, and differences from the staged fit."""
        return (*self.joint.warnings, *_beside_staged(self))

    def __getattr__(self, name: str):
        """Return the joint fit's attribute of this name."""
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
    """Calibrate by the staged pipeline, then by the joint fit without the staged fit's outliers.

    Args:
        data: at least three views with six visible points each.
        lens: the lens model of both fits; the paper's is `"radial"`.
        camera: a known camera, which both fits then hold.
        step2: `"kalman"`, the paper's filter, or `"batch"`, which is faster on many points.
        progress: called with a line of text for each stage.
        joint_options: passed on to `fit_joint`.

    Raises:
        ValueError: as `fit_staged` and `fit_joint` do.
    """
    if step2 not in STEP2:
        raise ValueError(f"step2 is one of {', '.join(STEP2)}; found {step2!r}")
    if camera is not None:
        joint_options["fixed"] = ("camera", *joint_options.get("fixed", ()))
    # Errors in the data are raised before the rehearsal, which cannot be interrupted.
    views_to_use(data, camera)
    with ThreadPoolExecutor(max_workers=1) as background:
        rehearsal = background.submit(rehearse, data, lens, camera, joint_options)
        staged = fit_staged(data, lens, camera=camera, step2=STEP2[step2], progress=progress)
        # Wait for the rehearsal. Its own errors are ignored: the real fit below raises the same
        # ones.
        rehearsal.exception()
    trusted = _seen_only(data, staged.inliers)
    joint = fit_joint(trusted, staged.calibration, progress=progress, **joint_options)
    # Residuals are reported for every observation, outliers too. The region is left out so that the
    # calibration has the structure for which the fits have already compiled `chain_residuals`.
    bare = dataclasses.replace(joint.calibration, region=None)
    everything = chain_residuals(bare, data.observations)
    joint = eqx.tree_at(lambda f: f.residuals, joint, everything)
    return CalibrationFit(staged, joint)


def best_uncorrected(data: Dataset, fit: CalibrationFit) -> Calibration:
    """Fit the chain that predicts best where the robot's error is not corrected.

    It is for programs that use transforms only. The fit takes the robot's poses as exact, so its
    camera and hand-eye transform absorb the robot's error: this hand-eye transform is not the best
    estimate of the camera's mount. Rejected observations stay out and held parameters stay held;
    priors are not known here.

    Args:
        data: the data set that `fit` was fitted to.
        fit: the calibration to refit without a correction.
    """
    start, moved = fit.joint.calibration.uncorrected, set(fit.joint.parameter_names)
    held = tuple(name for name in parameter_names(start) if name not in moved)
    free = tuple(name for name in ("target_scale",) if name in moved)
    used = _seen_only(data, fit.joint.problem.observations.visible)
    return fit_joint(used, start, noise="trusted", fixed=held, free=free).calibration


def _beside_staged(fit: CalibrationFit) -> tuple[str, ...]:
    """Return the warnings from comparing the joint fit's residuals with the staged fit's."""
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
    """Return the data with only these of the visible observations."""
    return eqx.tree_at(lambda d: d.visible, data, data.visible & these)
