"""Calibrate several folders together for `smartview calibrate`: cameras that watched one robot."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..files import refuse_unwritable
from .calibrate_folder import CalibrateSettings, loaded_folder
from .json_document import print_document, transform_document
from .terminal import progress_line

if TYPE_CHECKING:
    from ..joint import RigFit


def calibrate_rig_folders(
    folders: Sequence[Path], out: Path, settings: CalibrateSettings, json: bool
) -> bool:
    """Calibrate folders as the cameras of one rig; return whether the fit converged.

    A camera is called as its folder is. For each camera a calibration is written, `left.yaml`.

    Raises:
        ValueError: fewer than two folders, an option that a rig does not have, or data sets that
            do not belong to one robot.
    """
    from ..calibration_pipeline import calibrate
    from ..dataset import Rig

    _refuse_other_options(settings)
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < max(2, len(names)):
        raise ValueError(
            f"--together: expected folders of different names, one for each camera; found "
            f"{', '.join(names) or 'none'}"
        )
    refuse_unwritable(out, "--out")
    with progress_line() as progress:
        cameras = {
            name: loaded_folder(folder, settings, progress)[0]
            for name, folder in zip(names, folders, strict=True)
        }
        fit = calibrate(Rig(cameras), settings.lens, progress=progress)
    fit.save(out)
    files = [out / f"{name}.yaml" for name in names]
    if json:
        print_document("calibrate", {**_document(fit), "files": [str(file) for file in files]})
        return fit.result.converged
    typer.echo(str(fit))
    for name, entry in fit.rejected:
        place = "" if entry.point is None else f", point {entry.point}"
        typer.echo(f"left out: {name}, view {entry.view}{place}: {entry.reason}")
    for file in files:
        typer.echo(f"{file}: the calibration of this camera, with its covariance")
    return fit.result.converged


def _refuse_other_options(settings: CalibrateSettings) -> None:
    """Raise a ValueError for an option that a rig does not have."""
    known = settings.known
    given = [f"--{name}" for name, value in dataclasses.asdict(known).items() if value is not None]
    given += ["--diagnose"] * settings.diagnose
    given += ["--noise"] * (settings.noise != "estimated")
    if given:
        raise ValueError(
            f"{given[0]}: not with --together, which takes --lens, --bad-views and --out; "
            "sv.calibrate(sv.Rig(...)) takes the rest"
        )


def _document(fit: "RigFit") -> dict[str, Any]:
    """Return the result as plain numbers for `--json`."""
    cameras = {}
    for name, calibration in fit.calibrations.items():
        mount = calibration.transform_names[0]
        parts = [f"{part}.{k}" for part in ("translation", "rotation") for k in "xyz"]
        cameras[name] = {
            mount: transform_document(calibration.camera_from_mount),
            "std": {part: fit.std[f"{name}.{mount}.{part}"] for part in parts},
            "rms_px": fit.rms(name),
        }
    return {
        "cameras": cameras,
        "robot": {"translation": fit.noise.translation, "rotation": fit.noise.rotation},
        "states": len(fit.view_ids),
        "converged": fit.result.converged,
        "warnings": list(fit.warnings),
        "left_out": [
            {"camera": name, "view": e.view, "point": e.point, "reason": e.reason}
            for name, e in fit.rejected
        ],
    }
