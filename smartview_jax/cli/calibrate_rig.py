"""Calibrate the cameras that watched one robot together, for `smartview calibrate`."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from ..files import file_transaction, refuse_unwritable
from .calibrate_folder import CalibrateSettings, command_line, loaded_folder, run_name
from .fit_options import parse_rig_start
from .json_document import print_document, transform_document
from .terminal import progress_line

if TYPE_CHECKING:
    from ..dataset import Rig
    from ..evaluation import HeldOutErrors, RigErrorBudget
    from ..joint import RigFit


_Known = TypeVar("_Known")


class RigResult(NamedTuple):
    """A rig's fit and what was computed about it.

    Attributes:
        rig: the data sets of the cameras.
        name: name of the data.
        fit: the joint fit.
        held_out: errors of held-out states by camera; None where they were not computed.
        notes: remarks on the data, and on what could not be computed.
        budget: causes of the errors; None where they were not computed.
    """

    rig: "Rig"
    name: str
    fit: "RigFit"
    held_out: "dict[str, HeldOutErrors] | None"
    notes: tuple[str, ...]
    budget: "RigErrorBudget | None" = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes and warnings as lines for people."""
        return (*self.notes, *(f"warning: {text}" for text in self.fit.warnings))


def calibrate_rig_folders(
    folders: Sequence[Path], out: Path, settings: CalibrateSettings, json: bool
) -> bool:
    """Calibrate a folder with several cameras, or folders that are the cameras of one rig.

    For each camera a calibration is written, such as `left.yaml`, and one report for all.

    Returns:
        Whether the fit converged.

    Raises:
        ValueError: an option that a rig does not have, or data sets that do not belong to one
            robot.
    """
    _refuse_other_options(settings)
    refuse_unwritable(out, "--out")
    run = run_name()
    with progress_line() as progress:
        rig, name = _loaded_rig(folders, settings, progress)
        result = _calibrated_rig(rig, name, settings, progress)
    if not json:
        _print_result(result)
    with progress_line() as progress:
        progress("drawing the report")
        files = _write_files(result, out, run)
    if json:
        print_document("calibrate", {**_document(result), "run": run, "files": files})
    else:
        from typer import echo

        for file in files[:-1]:
            echo(f"{file}: {_what_it_holds(file, result.fit)}")
        echo(f"{files[-1]}: the report: results and accuracy")
    return result.fit.result.converged


def _loaded_rig(
    folders: Sequence[Path], settings: CalibrateSettings, progress: Callable[[str], None]
) -> "tuple[Rig, str]":
    """Load a folder with several cameras, or a folder for each camera, and return a name too."""
    from ..dataset import Rig
    from ..io import load_rig

    if len(folders) == 1:
        rig = load_rig(folders[0], settings.bad_views, progress)
        return rig, folders[0].resolve().name
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < max(2, len(names)):
        raise ValueError(
            f"--together: expected folders of different names, one for each camera; found "
            f"{', '.join(names) or 'none'}"
        )
    cameras = {
        name: loaded_folder(folder, settings, progress)[0]
        for name, folder in zip(names, folders, strict=True)
    }
    return Rig(cameras), ", ".join(names)


def _calibrated_rig(
    rig: "Rig", name: str, settings: CalibrateSettings, progress: Callable[[str], None]
) -> RigResult:
    """Fit a rig, and compute its held-out errors and the causes of its errors if requested."""
    from ..calibration_pipeline import calibrate
    from ..evaluation import (
        MIN_HELD_OUT_VIEWS,
        error_budget,
        held_out,
        without_rejected_rig_views,
    )
    from ..io import read_cameras

    notes = [f"{camera}: {note}" for camera, data in rig.cameras.items() for note in data.notes]
    known = None
    if settings.known.camera is not None:
        known = read_cameras(settings.known.camera, tuple(rig.cameras))
        notes.append(f"known cameras, held: {', '.join(known)}, from {settings.known.camera}")
    mounts = {camera: data.mount for camera, data in rig.cameras.items()}
    start = parse_rig_start(settings.known.start or (), mounts)
    if start is not None:
        notes.append(f"start given for {', '.join(start)}")
    fit = calibrate(rig, settings.lens, camera=known, start=start, progress=progress)
    scores, used = None, without_rejected_rig_views(rig, fit)
    if settings.held_out and len(used.usable_views()) < MIN_HELD_OUT_VIEWS:
        notes.append(f"held-out error needs at least {MIN_HELD_OUT_VIEWS} usable states: left out")
    elif settings.held_out:
        scores = held_out(
            used,
            lambda part: calibrate(
                part,
                settings.lens,
                camera=_of_cameras(part, known),
                start=_of_cameras(part, start),
            ),
            progress=lambda text: progress(f"held-out: {text}"),
        )
        # What failed for all cameras is said once.
        failures = dict.fromkeys(entry for own in scores.values() for entry in own.failures)
        notes += [f"held-out: fold {k + 1}: {reason}" for k, reason in failures]
    budget = None
    if settings.diagnose:
        try:
            budget = error_budget(rig, fit, progress)
        except ValueError as error:
            notes.append(f"no error budget: {error}")
    return RigResult(rig, name, fit, scores, tuple(notes), budget)


def _of_cameras(rig: "Rig", known: dict[str, _Known] | None) -> dict[str, _Known] | None:
    """Return what is known of the cameras that a rig has."""
    return known and {name: camera for name, camera in known.items() if name in rig.cameras}


def _refuse_other_options(settings: CalibrateSettings) -> None:
    """Raise a ValueError for an option that a rig does not have."""
    known = dataclasses.asdict(settings.known)
    taken = ("camera", "start")
    given = [f"--{name}" for name, value in known.items() if value and name not in taken]
    given += ["--noise"] * (settings.noise != "estimated")
    given += ["--mount"] * (settings.mount is not None)
    if given:
        raise ValueError(
            f"{given[0]}: not for several cameras together, which take --lens, --bad-views, "
            "--held-out, --diagnose, --camera, --start and --out; sv.calibrate(sv.Rig(...)) takes "
            "the rest"
        )


def _what_it_holds(file: Path, fit: "RigFit") -> str:
    """Return what a file of the result has, in words."""
    from ..joint import JOINT_SUFFIX, RIG_FILE

    if file.name == RIG_FILE:
        return "the covariance of all cameras together"
    if file.name.endswith(JOINT_SUFFIX):
        arm = file.name.removesuffix(JOINT_SUFFIX)
        return f"the covariance of all cameras of {arm} together"
    is_camera = file.stem in fit.calibrations
    kept = "the calibration of this camera" if is_camera else "where these arms are"
    return f"{kept}, with its covariance"


def _print_result(result: RigResult) -> None:
    """Print notes and warnings, a row for each camera and each pair, and what was left out."""
    from rich.console import Console
    from rich.table import Table

    from ..report import (
        CAMERA_HEADINGS,
        POSE_CAUSE_HEADINGS,
        RELATIVE_HEADINGS,
        base_rows,
        pose_cause_rows,
        relative_pose_rows,
        rig_budget_rows,
        rig_camera_rows,
        rig_summary,
    )

    console = Console()
    for note in result.remarks:
        console.print(note, highlight=False, markup=False)
    tables = [
        (CAMERA_HEADINGS, rig_camera_rows(result.fit, result.rig, result.held_out)),
        (RELATIVE_HEADINGS, relative_pose_rows(result.fit)),
        (RELATIVE_HEADINGS, base_rows(result.fit)),
    ]
    if result.budget is not None:
        headings = ("error by cause (px)", *result.budget.cameras)
        tables.append((headings, rig_budget_rows(result.budget)))
        tables.append((POSE_CAUSE_HEADINGS, pose_cause_rows(result.budget)))
    for headings, rows in tables:
        if rows:
            table = Table(*headings)
            for row in rows:
                table.add_row(*row)
            console.print(table)
    console.print(rig_summary(result.fit, result.held_out), highlight=False)
    for name, sensor in result.fit.sensors.items():
        console.print(f"{name}: depth sensor: {sensor.described}", highlight=False, markup=False)
    if result.budget is not None:
        for name, budget in result.budget.cameras.items():
            console.print(f"{name}: {budget.summary}", highlight=False, markup=False)
    for name, entry in result.fit.rejected:
        place = "" if entry.point is None else f", point {entry.point}"
        console.print(
            f"left out: {name}, view {entry.view}{place}: {entry.reason}",
            highlight=False,
            markup=False,
        )


def _write_files(result: RigResult, out: Path, run: str) -> list[Path]:
    """Write the cameras' calibrations and the report, all or none, and return their paths."""
    from ..report import Origin, write_rig_page

    names = [*result.fit.file_names, "report.html"]
    with file_transaction(out, tuple(names)) as folder:
        result.fit.save(folder, run)
        origin = Origin(result.name, command_line(), run)
        page = folder / "report.html"
        write_rig_page(
            page, result.fit, result.rig, result.held_out, origin, result.remarks, result.budget
        )
    return [out / name for name in names]


def _document(result: RigResult) -> dict[str, Any]:
    """Return the result as plain numbers for `--json`."""
    fit, cameras = result.fit, {}
    for name, calibration in fit.calibrations.items():
        mount = calibration.transform_names[0]
        parts = [f"{part}.{k}" for part in ("translation", "rotation") for k in "xyz"]
        scores = None if result.held_out is None else result.held_out[name].errors.rms
        sensor = fit.sensors.get(name)
        cameras[name] = {
            mount: transform_document(calibration.camera_from_mount),
            "std": {part: fit.std[f"{name}.{mount}.{part}"] for part in parts},
            "rms_px": fit.rms(name),
            "held_out_rms_px": scores,
            "depth_sensor": None if sensor is None else dataclasses.asdict(sensor),
        }
    robots = {
        name: {"translation": noise.translation, "rotation": noise.rotation}
        for name, noise in fit.noises.items()
    }
    arms = {name: {**robots[name], **_base_document(fit, name)} for name in fit.bases}
    return {
        "cameras": cameras,
        **({"arms": arms} if arms else {"robot": next(iter(robots.values()))}),
        "states": len(fit.view_ids),
        "converged": fit.result.converged,
        "budget": None if result.budget is None else _budget_document(result.budget),
        "notes": list(result.notes),
        "warnings": list(fit.warnings),
        "left_out": [
            {"camera": name, "view": e.view, "point": e.point, "reason": e.reason}
            for name, e in fit.rejected
        ],
    }


def _budget_document(budget: "RigErrorBudget") -> dict[str, Any]:
    """Return the causes of the errors of a rig as plain numbers."""
    from .calibrate_document import budget_document

    return {
        "cameras": {name: budget_document(own) for name, own in budget.cameras.items()},
        "poses": {
            pose.name: {
                "std": {"translation": pose.translation, "rotation": pose.rotation},
                "causes": [cause._asdict() for cause in pose.causes],
            }
            for pose in budget.poses
        },
    }


def _base_document(fit: "RigFit", arm: str) -> dict[str, Any]:
    """Return the pose of an arm's base in the base of the first arm as plain numbers."""
    first = next(iter(fit.bases))
    base = fit.base(first, arm)
    return {
        "cameras": [name for name, own in fit.arms.items() if own == arm],
        f"base_{first}_from_base": transform_document(base.transform),
        "std": {"translation": base.std[:3].tolist(), "rotation": base.std[3:].tolist()},
    }
