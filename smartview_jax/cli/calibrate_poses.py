"""Calibrate tracked poses for `smartview calibrate`: pairs of poses in place of pictures."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

import smartview_jax as sv

from ..export_text import MOUNT_FRAMES
from .calibrate_folder import CalibrateSettings
from .calibrate_result import AbstractResult
from .documents import fit_entries, rejection_entries
from .fit_options import FitOptions, parse_fit_options
from .terminal import print_lines, print_table, verbose

RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "hand_eye.calib": "the hand-eye transform, which the publisher of easy_handeye2 reads",
    "report.html": "the report: results and accuracy",
}
"""Descriptions of the files that `calibrate` writes for tracked poses, by file name."""


@dataclass(frozen=True)
class PoseResult(AbstractResult):
    """A fit to tracked poses and errors of held-out pairs, None where they were not computed."""

    data: "sv.dataset.PoseDataset"
    name: str
    fit: "sv.joint.PoseFit"
    held_out: "sv.evaluation.HeldOutPoses | None"
    notes: tuple[str, ...]
    given: str

    @property
    def file_descriptions(self) -> dict[str, str]:
        return RESULT_FILES

    def print(self) -> None:
        fit, report = self.fit, sv.report
        print_lines(sv.joint.fit_text(fit, (), verbose()), *self.remarks)
        print_table(("", "distance", "angle"), report.pose_error_rows(fit, self.held_out))
        print_lines(report.pose_fit_summary(fit, self.held_out))
        left_out = report.rejections(fit, self.data)
        if left_out:
            print_lines("left out:", *(f"  pair {pair}: {reason}" for pair, reason in left_out))
        if not fit.has_camera:
            print_lines(
                "no calibration.yaml: poses do not tell the camera; give it by --camera, which is "
                "not fitted"
            )

    def write_files(self, folder: Path, run: str, progress: Callable[[str], None]) -> None:
        fit = self.fit
        parent = MOUNT_FRAMES[fit.calibration.mount]
        progress("drawing the report")
        if fit.has_camera:
            fit.save(folder / "calibration.yaml", run, self.source)
        text = sv.io.easy_handeye_calibration(fit.calibration, parent, "camera_optical_frame")
        (folder / "hand_eye.calib").write_text(text, encoding="utf-8")
        page = folder / "report.html"
        sv.report.write_pose_page(page, fit, self.data, self.held_out, self.origin(run), self.notes)

    def entries(self, run: str) -> dict[str, Any]:
        fit, held_out = self.fit, self.held_out
        entries = fit_entries(self.name, run, self.given, fit)
        if not fit.has_camera:
            entries["camera"] = None
        return {
            **entries,
            "tracker_std": _length_and_angle(fit.tracker_noise),
            "fitted_rms": _length_and_angle(fit.rms),
            "held_out_rms": None if held_out is None else _length_and_angle(held_out.rms),
            **rejection_entries(fit, self.data),
        }


def calibrated_poses(
    data: "sv.dataset.PoseDataset",
    name: str,
    settings: CalibrateSettings,
    progress: Callable[[str], None],
) -> PoseResult:
    """Fit tracked poses, and compute their held-out errors if requested."""
    if settings.diagnose or settings.noise != "estimated":
        option = "--diagnose" if settings.diagnose else "--noise"
        raise ValueError(f"{option}: expected a data set with pictures; {name} has tracked poses")
    options = parse_fit_options(settings.lens, data.mount, settings.known)
    arguments = _arguments(options)
    fit = sv.fit_poses(data, progress=progress, **arguments)
    notes, scores = list(data.notes), None
    used = cast("sv.dataset.PoseDataset", sv.evaluation.without_rejected_views(data, fit))
    least = sv.evaluation.MIN_HELD_OUT_VIEWS
    if settings.held_out and len(used.usable_views()) < least:
        notes.append(f"held-out error needs at least {least} usable pairs: left out")
    elif settings.held_out:
        scores = sv.evaluation.held_out_poses(
            used, lambda part: sv.fit_poses(part, **arguments), progress=progress
        )
        notes += [f"fold {k + 1}: {reason}" for k, reason in scores.failures]
    return PoseResult(data, name, fit, scores, tuple(notes), options.given)


def _arguments(options: FitOptions) -> dict[str, Any]:
    """Return the keyword arguments of `fit_poses`."""
    arguments = options.arguments()
    if "target_scale" in arguments.pop("free", ()):
        arguments["scale"] = True
    start = arguments.get("start")
    if start is not None and not isinstance(start, dict):
        first, second = start.transform_names
        arguments["start"] = {first: start.camera_from_mount, second: start.holder_from_world}
    return arguments


def _length_and_angle(values: Any) -> dict[str, float]:
    """Return a length (m) and an angle (rad) as they are printed."""
    return {"mm": 1e3 * float(values[0]), "deg": float(np.rad2deg(values[1]))}
