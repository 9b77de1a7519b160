"""A real arm calibrated together with its camera: lwr4_joint, told by its joint angles.

Seven joints whose zeros are off by up to a degree, and a board whose squares' size nobody wrote
down. The bounds of the fitted error are a little above what SciPy reaches on the same corners
(1.214 px); corrections of single views are left out of every figure.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import smartview_jax as sv
from smartview_jax.evaluation import reprojection_errors

from .real_sets import LENS, held_out_px, load, present

SET = ("lwr4_joint", "")
ESTIMATED = "errors estimated, scale"


class Row(NamedTuple):
    """A fit and its bounds, px: fitted, five folds, each view by itself; None where none is set."""

    name: str
    options: Callable[[sv.Dataset], dict[str, Any]]
    bounds: tuple[float | None, float | None, float | None]


ROWS = (
    Row("nominal kinematics", lambda _: {"noise": "trusted"}, (None, None, None)),
    Row(
        "zeros of joints 2 to 6, scale",
        lambda data: {
            "noise": "trusted",
            "field": sv.robot_errors.JointOffsets(data.arm),
            "free": ("target_scale",),
            # The first joint's zero is the board's place, the last one's the camera's mount.
            "fixed": ("robot_error.joint_offset.1", "robot_error.joint_offset.7"),
        },
        (1.25, None, None),
    ),
    Row(
        ESTIMATED,
        lambda _: {"noise": "estimated", "free": ("target_scale",)},
        (0.6, 1.6, 1.5),
    ),
)


def run(smoke: bool = False) -> bool:
    """Print the table; True where every figure is within its bound."""
    if not present((SET,)):
        return True
    data, _ = load(*SET)
    print(f"{'px RMS':32}{'fitted':>10}{'5 folds':>10}{'each view':>11}   bounds")
    good = True
    for row in ROWS[:2] if smoke else ROWS:
        fit = _fitter(row)
        found = fit(data)
        figures = [reprojection_errors(found.calibration, data).rms]
        if not smoke:
            folds = (5, len(data.usable_views()))
            figures += [held_out_px(data, fit, k) for k in folds]
        kept = all(
            bound is None or figure <= bound
            for figure, bound in zip(figures, row.bounds, strict=False)
        )
        good = good and kept
        bounds = ", ".join("-" if bound is None else f"{bound:g}" for bound in row.bounds)
        print(
            f"{row.name:32}{figures[0]:10.3f}"
            + "".join(f"{figure:{10 + k}.3f}" for k, figure in enumerate(figures[1:]))
            + f"   {bounds}{'' if kept else '  OUT OF BOUND'}",
            flush=True,
        )
        if row.name == ESTIMATED:
            _print_zeros(found)
    return good


def _fitter(row: Row) -> Callable[[sv.Dataset], sv.JointFit]:
    def fit(data: sv.Dataset) -> sv.JointFit:
        start = sv.fit_staged(data, LENS).calibration
        return sv.fit_joint(data, start, **row.options(data))

    return fit


def _print_zeros(fit: sv.JointFit) -> None:
    error = fit.calibration.robot_error
    if error is None:
        return
    for k, zero in enumerate(error.coefficients[:7]):
        std = fit.std[f"robot_error.joint_offset.{1 + k}"]
        print(f"zero of joint {1 + k}: {np.rad2deg(zero):7.3f} +- {np.rad2deg(std):.3f} degrees")
    scale = float(fit.calibration.target_scale)
    print(f"size of the board: {scale:.4f} +- {fit.std['target_scale']:.4f} of the stated size")
