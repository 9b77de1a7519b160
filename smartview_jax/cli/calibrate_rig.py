"""Calibrate the cameras that watched one robot together, for `smartview calibrate`."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import smartview_jax as sv

from .calibrate_folder import CalibrateSettings, loaded_folder
from .calibrate_result import AbstractResult
from .documents import budget_document, transform_document
from .fit_options import parse_rig_aspects, parse_rig_start
from .terminal import print_lines, print_table

_Known = TypeVar("_Known")


@dataclass(frozen=True)
class RigResult(AbstractResult):
    """A rig's fit and what was computed about it.

    Attributes:
        held_out: errors of held-out states by camera; None where they were not computed.
        budget: causes of the errors; None where they were not computed.
    """

    rig: "sv.Rig"
    name: str
    fit: "sv.RigFit"
    held_out: "dict[str, sv.evaluation.HeldOutErrors] | None"
    notes: tuple[str, ...]
    budget: "sv.evaluation.RigErrorBudget | None" = None

    def print(self) -> None:
        fit, budget, report = self.fit, self.budget, sv.report
        print_lines(*self.remarks)
        tables = [
            (report.CAMERA_HEADINGS, report.rig_camera_rows(fit, self.rig, self.held_out)),
            (report.RELATIVE_HEADINGS, report.relative_pose_rows(fit)),
            (report.RELATIVE_HEADINGS, report.base_rows(fit)),
        ]
        if budget is not None:
            headings = ("error by cause (px)", *budget.cameras)
            tables.append((headings, report.rig_budget_rows(budget)))
            tables.append((report.POSE_CAUSE_HEADINGS, report.pose_cause_rows(budget)))
        for headings, rows in tables:
            if rows:
                print_table(headings, rows)
        print_lines(report.rig_summary(fit, self.held_out))
        sensors = fit.sensors.items()
        print_lines(*(f"{name}: depth sensor: {sensor.described}" for name, sensor in sensors))
        if budget is not None:
            print_lines(*(f"{name}: {part.summary}" for name, part in budget.cameras.items()))
        for name, entry in fit.rejected:
            place = "" if entry.point is None else f", point {entry.point}"
            print_lines(f"left out: {name}, view {entry.view}{place}: {entry.reason}")

    @property
    def file_descriptions(self) -> dict[str, str]:
        calibrations = {name: _described_file(Path(name), self.fit) for name in self.fit.file_names}
        return calibrations | {"report.html": "the report: results and accuracy"}

    def write_files(self, folder: Path, run: str, progress: Callable[[str], None]) -> None:
        progress("drawing the report")
        self.fit.save(folder, run)
        page, origin = folder / "report.html", self.origin(run)
        sv.report.write_rig_page(
            page, self.fit, self.rig, self.held_out, origin, self.notes, self.budget
        )

    def entries(self, run: str) -> dict[str, Any]:
        fit, cameras = self.fit, {}
        for name, calibration in fit.calibrations.items():
            mount = calibration.transform_names[0]
            parts = [f"{part}.{k}" for part in ("translation", "rotation") for k in "xyz"]
            scores = None if self.held_out is None else self.held_out[name].errors.rms
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
        arms = {name: {**robots.pop(name, {}), **_base_document(fit, name)} for name in fit.bases}
        relative = {
            f"{second} in {first}": _relative_document(fit.relative(first, second))
            for first, second in combinations(cameras, 2)
            if fit.on_one_mount(first, second)
        }
        return {
            "cameras": cameras,
            "relative": relative,
            **({"arms": arms} if arms else {"robot": next(iter(robots.values()))}),
            # Of pairs, whose poses are of one hand in the other's frame.
            **({"pairs": robots} if arms and robots else {}),
            "states": len(fit.view_ids),
            "converged": fit.result.converged,
            "budget": None if self.budget is None else _budget_document(self.budget),
            "left_out": [
                {"camera": name, "view": e.view, "point": e.point, "reason": e.reason}
                for name, e in fit.rejected
            ],
            "run": run,
        }


def loaded_rig(
    folders: Sequence[Path], settings: CalibrateSettings, progress: Callable[[str], None]
) -> "tuple[sv.Rig, str]":
    """Load a folder with several cameras, or a folder for each camera, and return a name too."""
    _refuse_other_options(settings)
    if len(folders) == 1:
        rig = sv.load_rig(folders[0], settings.bad_views, progress)
        return rig, folders[0].resolve().name
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < max(2, len(names)):
        raise ValueError(
            f"--together: expected folders of different names, one for each camera; found "
            f"{', '.join(names) or 'none'}"
        )
    for folder in folders:
        if folder.is_dir() and sv.io.is_rig_folder(folder):
            raise ValueError(
                f"--together: expected a folder for each camera; {folder} has several cameras"
            )
    cameras = {
        name: loaded_folder(folder, settings, progress)[0]
        for name, folder in zip(names, folders, strict=True)
    }
    return sv.Rig(cameras), ", ".join(names)


def fitted_rig(
    rig: "sv.Rig", name: str, settings: CalibrateSettings, progress: Callable[[str], None]
) -> RigResult:
    """Fit a rig, and compute its held-out errors and the causes of its errors if requested."""
    notes = list(rig.notes)
    known = None
    if settings.known.camera is not None:
        known = sv.io.read_cameras(settings.known.camera, tuple(rig.cameras))
        notes.append(f"known cameras, held: {', '.join(known)}, from {settings.known.camera}")
    mounts = {camera: data.mount for camera, data in rig.cameras.items()}
    start = parse_rig_start(settings.known.start or (), mounts)
    if start is not None:
        notes.append(f"start given for {', '.join(start)}")
    aspects = parse_rig_aspects(settings.known.prior or (), tuple(rig.cameras), known or ())
    notes += [f"given: --prior {text}" for text in settings.known.prior or ()]
    fit = sv.calibrate(
        rig, settings.lens, camera=known, start=start, priors=aspects or None, progress=progress
    )
    scores, used = None, sv.evaluation.without_rejected_rig_views(rig, fit)
    least = sv.evaluation.MIN_HELD_OUT_VIEWS
    if settings.held_out and len(used.usable_views()) < least:
        notes.append(f"held-out error needs at least {least} usable states: left out")
    elif settings.held_out:
        scores = sv.held_out(
            used,
            lambda part: sv.calibrate(
                part,
                settings.lens,
                camera=_of_cameras(part, known),
                start=_of_cameras(part, start),
                priors=_of_cameras(part, aspects) or None,
            ),
            progress=lambda text: progress(f"held-out: {text}"),
        )
        # What failed for all cameras is said once.
        failures = dict.fromkeys(entry for score in scores.values() for entry in score.failures)
        notes += [f"held-out: fold {k + 1}: {reason}" for k, reason in failures]
    budget = None
    if settings.diagnose:
        try:
            budget = sv.error_budget(rig, fit, progress)
        except ValueError as error:
            notes.append(f"no error budget: {error}")
    return RigResult(rig, name, fit, scores, tuple(notes), budget)


def _of_cameras(rig: "sv.Rig", known: dict[str, _Known] | None) -> dict[str, _Known] | None:
    """Return what is known of the cameras that a rig has, by name or by path of a pixel aspect."""
    aspect = f".{sv.engine.PIXEL_ASPECT}"
    return known and {
        path: value for path, value in known.items() if path.removesuffix(aspect) in rig.cameras
    }


def _refuse_other_options(settings: CalibrateSettings) -> None:
    known = dataclasses.asdict(settings.known)
    taken = ("camera", "start", "prior")
    given = [f"--{name}" for name, value in known.items() if value and name not in taken]
    given += ["--noise"] * (settings.noise != "estimated")
    given += ["--mount"] * (settings.mount is not None)
    given += ["--base-from-world"] * (settings.base_from_world is not None)
    given += ["--time-offset"] * settings.time_offset
    if given:
        raise ValueError(
            f"{given[0]}: not for several cameras together, which take --lens, --bad-views, "
            "--held-out, --diagnose, --camera, --start, --prior and --out; "
            "sv.calibrate(sv.Rig(...)) takes the rest"
        )


def _described_file(file: Path, fit: "sv.RigFit") -> str:
    """Return what a file of the result has, in words."""
    if file.name == sv.joint.RIG_FILE:
        return "the covariance of all cameras together"
    if file.name.endswith(sv.joint.JOINT_SUFFIX):
        arm = file.name.removesuffix(sv.joint.JOINT_SUFFIX)
        return f"the covariance of all cameras of {arm} together"
    is_camera = file.stem in fit.calibrations
    kept = "the calibration of this camera" if is_camera else "where these arms are"
    return f"{kept}, with its covariance"


def _budget_document(budget: "sv.evaluation.RigErrorBudget") -> dict[str, Any]:
    """Return the causes of the errors of a rig as plain numbers."""
    return {
        "cameras": {name: budget_document(entry) for name, entry in budget.cameras.items()},
        "poses": {
            pose.name: {
                "std": {"translation": pose.translation, "rotation": pose.rotation},
                "causes": [cause._asdict() for cause in pose.causes],
            }
            for pose in budget.poses
        },
    }


def _relative_document(relative: "sv.RelativePose") -> dict[str, Any]:
    """Return the pose of one camera in another's frame, with 95 % intervals, as plain numbers."""
    widths = relative.half_widths().tolist()
    return {
        "first_from_second": transform_document(relative.transform),
        "std": {"translation": relative.std[:3].tolist(), "rotation": relative.std[3:].tolist()},
        "half_width_95": {"translation": widths[:3], "rotation": widths[3:]},
    }


def _base_document(fit: "sv.RigFit", arm: str) -> dict[str, Any]:
    """Return the pose of an arm's base in the base of the first arm as plain numbers."""
    first = next(iter(fit.bases))
    base = fit.base(first, arm)
    return {
        "cameras": [
            name for name, of_camera in fit.arms.items() if arm in sv.dataset.arms_of(of_camera)
        ],
        f"base_{first}_from_base": transform_document(base.transform),
        "std": {"translation": base.std[:3].tolist(), "rotation": base.std[3:].tolist()},
    }
