"""Calibrate tracked poses for `smartview calibrate`: pairs of poses in place of pictures."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from ..files import file_transaction
from .calibrate_folder import CalibrateSettings, command_line, provenance
from .error_documents import views_left_out
from .fit_options import FitOptions, parse_fit_options

if TYPE_CHECKING:
    from ..dataset import PoseDataset
    from ..evaluation import HeldOutPoses
    from ..joint import PoseFit

POSE_RESULT_FILES = {
    "calibration.yaml": "the calibration",
    "hand_eye.calib": "the hand-eye transform, which the publisher of easy_handeye2 reads",
    "report.html": "the report: results and accuracy",
}
"""Descriptions of the files that `calibrate` writes for tracked poses, by file name."""


class PoseResult(NamedTuple):
    """A fit to tracked poses and what was computed about it.

    Attributes:
        data: the pairs.
        name: the data set's name.
        fit: the joint fit.
        held_out: errors of held-out pairs; None where they were not computed.
        notes: remarks on the data, and on what could not be computed.
        given: the options that state prior knowledge, in words.
    """

    data: "PoseDataset"
    name: str
    fit: "PoseFit"
    held_out: "HeldOutPoses | None"
    notes: tuple[str, ...]
    given: str

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes and warnings as lines for people."""
        return (*self.notes, *(f"warning: {text}" for text in self.fit.warnings))


def calibrated_poses(
    data: "PoseDataset",
    name: str,
    settings: CalibrateSettings,
    progress: Callable[[str], None],
) -> PoseResult:
    """Fit tracked poses, and compute their held-out errors if requested.

    Raises:
        ValueError: an option that only pictures have, and the errors of `fit_poses`.
    """
    from ..evaluation import MIN_HELD_OUT_VIEWS, held_out_poses, without_rejected_views
    from ..joint import fit_poses

    if settings.diagnose or settings.noise != "estimated":
        option = "--diagnose" if settings.diagnose else "--noise"
        raise ValueError(f"{option}: expected a data set with pictures; {name} has tracked poses")
    options = parse_fit_options(settings.lens, data.mount, settings.known)
    arguments = _arguments(options)
    fit = fit_poses(data, progress=progress, **arguments)
    notes, scores = list(data.notes), None
    used = cast("PoseDataset", without_rejected_views(data, fit))
    if settings.held_out and len(used.usable_views()) < MIN_HELD_OUT_VIEWS:
        notes.append(f"held-out error needs at least {MIN_HELD_OUT_VIEWS} usable pairs: left out")
    elif settings.held_out:
        scores = held_out_poses(used, lambda part: fit_poses(part, **arguments), progress=progress)
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


def print_pose_result(result: PoseResult) -> None:
    """Print the hand-eye transform, notes and warnings, errors and the pairs left out."""
    from rich.console import Console
    from rich.table import Table

    from ..joint import fit_text
    from ..report import pose_error_rows, pose_fit_summary, rejections
    from .calibrate_tables import verbose

    console = Console()
    console.print(fit_text(result.fit, (), verbose()), highlight=False, markup=False)
    for note in result.remarks:
        console.print(note, highlight=False, markup=False)
    table = Table("", "distance", "angle")
    for row in pose_error_rows(result.fit, result.held_out):
        table.add_row(*row)
    console.print(table)
    console.print(pose_fit_summary(result.fit, result.held_out), highlight=False)
    left_out = rejections(result.fit, result.data)
    if left_out:
        console.print("left out:")
    for pair, reason in left_out:
        console.print(f"  pair {pair}: {reason}", highlight=False, markup=False)
    if not result.fit.has_camera:
        console.print(
            "no calibration.yaml: poses do not tell the camera; give it by --camera, which is not "
            "fitted",
            highlight=False,
        )


def write_pose_files(result: PoseResult, out: Path, run: str) -> list[Path]:
    """Write all files of a run, or none, and return the paths written."""
    from ..export_text import MOUNT_FRAMES
    from ..io import easy_handeye_calibration
    from ..report import Origin, write_pose_page

    fit = result.fit
    parent = MOUNT_FRAMES[fit.calibration.mount]
    with file_transaction(out, tuple(POSE_RESULT_FILES)) as folder:
        if fit.has_camera:
            fit.save(folder / "calibration.yaml", run, provenance(result.name, result.given))
        text = easy_handeye_calibration(fit.calibration, parent, "camera_optical_frame")
        (folder / "hand_eye.calib").write_text(text, encoding="utf-8")
        write_pose_page(
            folder / "report.html",
            fit,
            result.data,
            result.held_out,
            Origin(result.name, command_line(), run, result.given),
            result.remarks,
        )
    return [out / file for file in POSE_RESULT_FILES if (out / file).is_file()]


def pose_document(result: PoseResult, run: str, files: list[Path]) -> dict[str, Any]:
    """Return everything that was computed, as values for programs."""
    from ..report import rejections
    from .calibrate_document import fit_entries

    fit = result.fit
    entries = fit_entries(result.name, run, result.given, fit)
    if not fit.has_camera:
        entries["camera"] = None
    return {
        **entries,
        "tracker_std": _length_and_angle(fit.tracker_noise),
        "fitted_rms": _length_and_angle(fit.rms),
        "held_out_rms": None if result.held_out is None else _length_and_angle(result.held_out.rms),
        "rejected": [
            {"view": view, "reason": reason} for view, reason in rejections(fit, result.data)
        ],
        "left_out_views": views_left_out(result.data.masked_views),
        "undetermined": [direction.description for direction in fit.observability.null_directions],
        "notes": list(result.notes),
        "warnings": list(fit.warnings),
        "files": files,
    }


def _length_and_angle(values: Any) -> dict[str, float]:
    """Return a length (m) and an angle (rad) as they are printed."""
    import numpy as np

    return {"mm": 1e3 * float(values[0]), "deg": float(np.rad2deg(values[1]))}
