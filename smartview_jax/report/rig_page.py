"""Write the report of a rig's fit: one page, with a section for each camera."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from .. import plots
from ..dataset import Rig, arms_of, is_pair
from ..evaluation import (
    HeldOutErrors,
    PoseUncertainty,
    RigErrorBudget,
    pose_uncertainties,
    reprojection_errors,
    without_rejected_rig_views,
)
from ..geometry import host_matrices, vector_text
from ..joint import RelativePose, RigFit, calibration_forms
from .page import Origin, origin_facts, page_title, prediction_overlays
from .story import Section, StoryFigure, remarks_sections, write_story
from .tables import ErrorSummary

CAMERA_HEADINGS = (
    "camera",
    "views",
    "RMS px",
    "held-out px",
    "x, y, z (mm)",
    "+- mm",
    "+- deg",
)
"""Headings of `rig_camera_rows`; the two intervals hold 95 %, along the least known axis."""

RELATIVE_HEADINGS = ("second in first", "x, y, z (mm)", "+- mm", "+- deg")
"""Headings of `relative_pose_rows` and `base_rows`, with half widths of 95 % intervals."""

POSE_CAUSE_HEADINGS = ("pose", "mm", "deg", "causes of the variance of the translation")
"""Headings of `pose_cause_rows`; the numbers are standard deviations of all axes together."""

MIN_SHOWN_SHARE = 0.01
"""Smallest share of a variance for which its cause is named."""


def rig_camera_rows(
    fit: RigFit, rig: Rig, held_out: Mapping[str, HeldOutErrors] | None = None
) -> list[tuple[str, ...]]:
    """Return a row for each camera: its views, errors (held out, if any), place and intervals."""
    used, rows = without_rejected_rig_views(rig, fit), []
    for name, calibration in fit.calibrations.items():
        data = used.cameras[name]
        error = reprojection_errors(calibration, data).rms
        unseen = "" if held_out is None else _rms_text(held_out[name].errors.rms)
        position = 1e3 * host_matrices(calibration.camera_from_mount)[:3, 3]
        mount = f"{name}.{calibration.transform_names[0]}"
        widths = [
            max(_half_width(fit, f"{mount}.{part}.{axis}") for axis in "xyz")
            for part in ("translation", "rotation")
        ]
        rows.append(
            (
                name,
                f"{len(data.usable_views())}/{data.view_count}",
                f"{error:.3f}",
                unseen,
                vector_text(position, 1).strip("()"),
                f"{1e3 * widths[0]:.2g}",
                f"{np.rad2deg(widths[1]):.2g}",
            )
        )
    return rows


def _rms_text(rms: float) -> str:
    """Return an error, px; a dash where no view could be held out."""
    return f"{rms:.3f}" if np.isfinite(rms) else "-"


def _half_width(fit: RigFit, name: str) -> float:
    """Return the half width of a 95 % interval; zero for a parameter that was held."""
    return fit.confidence_half_width(name) if name in fit.std else 0.0


def relative_pose_rows(fit: RigFit) -> list[tuple[str, ...]]:
    """Return a row for each pair of cameras on one mount: the second's pose in the first's frame.

    They are cameras on one hand, or next to one arm. The 95 % intervals are along the least known
    axis.
    """
    rows = []
    for first, second in combinations(fit.calibrations, 2):
        if fit.on_one_mount(first, second):
            rows.append(_relative_row(first, second, fit.relative(first, second)))
    return rows


def base_rows(fit: RigFit) -> list[tuple[str, ...]]:
    """Return a row for each pair of arms: the second's base in the first's.

    The 95 % intervals are along the least known axis.
    """
    return [
        _relative_row(first, second, fit.base(first, second))
        for first, second in combinations(fit.bases, 2)
    ]


def _relative_row(first: str, second: str, relative: RelativePose) -> tuple[str, ...]:
    """Return the row of one pair: the second's pose in the first's frame."""
    return (
        f"{second} in {first}",
        vector_text(1e3 * host_matrices(relative.transform)[:3, 3], 2).strip("()"),
        f"{1e3 * relative.half_widths()[:3].max():.2g}",
        f"{np.rad2deg(relative.half_widths()[3:].max()):.2g}",
    )


def rig_budget_rows(budget: RigErrorBudget) -> list[tuple[str, ...]]:
    """Return a row for each cause of error: its RMS in every camera's uncorrected chain, px.

    Causes are in the order of their largest error; a camera without a cause has an empty entry.
    """
    of_cameras = [{c.name: c.rms for c in entry.causes} for entry in budget.cameras.values()]
    names = dict.fromkeys(name for causes in of_cameras for name in causes)
    largest = {name: max(causes.get(name, 0.0) for causes in of_cameras) for name in names}
    return [
        (name, *(f"{causes[name]:.3g}" if name in causes else "" for causes in of_cameras))
        for name in sorted(names, key=lambda name: -largest[name])
    ]


def pose_cause_rows(budget: RigErrorBudget) -> list[tuple[str, ...]]:
    """Return a row for each pose: its standard deviations, and the share of each cause."""
    rows = []
    for pose in budget.poses:
        variance = pose.translation**2
        shares = [
            f"{cause.name} {cause.translation**2 / variance:.0%}"
            for cause in pose.causes
            if cause.translation**2 >= MIN_SHOWN_SHARE * variance > 0.0
        ]
        rows.append(
            (
                pose.name.replace(".", ": "),
                f"{1e3 * pose.translation:.2g}",
                f"{np.rad2deg(pose.rotation):.2g}",
                ", ".join(shares),
            )
        )
    return rows


def rig_summary(fit: RigFit, held_out: Mapping[str, HeldOutErrors] | None = None) -> str:
    """Return the result in a few sentences."""
    if not fit.result.converged:
        return f"The joint fit did not converge: {fit.result.message}."
    noises = {
        name: f"{1e3 * robot.translation:.2g} mm and {np.rad2deg(robot.rotation):.2g} degrees"
        for name, robot in fit.noises.items()
    }
    count = len(fit.calibrations)
    if fit.bases:
        each = ", ".join(f"{text} ({_described_arm(name)})" for name, text in noises.items())
        text = (
            f"{count} cameras and {len(fit.bases)} arms were calibrated together. The arms' "
            f"reported poses have noise of {each} per axis."
        )
    else:
        (noise,) = noises.values()
        text = (
            f"{count} cameras and one robot were calibrated together. The robot's "
            f"reported poses have noise of {noise} per axis."
        )
    errors = {} if held_out is None else {name: e.errors.rms for name, e in held_out.items()}
    errors = {name: rms for name, rms in errors.items() if np.isfinite(rms)}
    if errors:
        worst = max(errors, key=lambda name: errors[name])
        text += (
            f" States of the robot that the fit never saw are predicted to {errors[worst]:.3g} px "
            f"RMS or better (camera {worst})."
        )
    return text


def _described_arm(name: str) -> str:
    """Return the name of an arm, or what the reported poses of a pair of arms are."""
    return f"{name}, of one hand in the other's frame" if is_pair(name) else name


def write_rig_page(
    path: Path,
    fit: RigFit,
    rig: Rig,
    held_out: Mapping[str, HeldOutErrors] | None = None,
    origin: Origin | None = None,
    notes: Sequence[str] | None = None,
    budget: RigErrorBudget | None = None,
) -> None:
    """Write the report of a rig's fit as an HTML page.

    Args:
        path: of the HTML file, which is written completely or not at all.
        held_out: result of `held_out` for the rig; None if not computed.
        origin: data set and command of the page; None for a script's own data.
        notes: notes to print; None for the notes of the rig's data sets.
        budget: result of `error_budget` for the rig; None if not computed.
    """
    sections = remarks_sections(fit.warnings, rig.notes if notes is None else notes)
    sections.append(
        Section(
            "Cameras",
            "Errors are RMS distances from the points predicted from the robot's poses alone, on "
            "fitted and on held-out states. Positions are the camera's "
            "transforms (camera_from_tool, or camera_from_base next to the arm), with 95 % "
            "intervals along their least known axes.",
            header=CAMERA_HEADINGS,
            rows=rig_camera_rows(fit, rig, held_out),
        )
    )
    pairs = relative_pose_rows(fit)
    if pairs:
        text = "Poses of cameras on one mount in another's frame, by their joint covariance (95 %)."
        sections.append(Section("Between the cameras", text, header=RELATIVE_HEADINGS, rows=pairs))
    if arms := base_rows(fit):
        text = (
            "Bases of the arms in the base of another, by targets that several arms see, or that "
            "one arm carries and another sees."
        )
        sections.append(Section("Between the arms", text, header=RELATIVE_HEADINGS, rows=arms))
    used = without_rejected_rig_views(rig, fit)
    poses = pose_uncertainties(fit) if budget is None else budget.poses
    sections.append(_joint_section(fit, used, poses))
    sections += [_camera_section(fit, used, name, held_out) for name in fit.calibrations]
    if budget is not None:
        sections += _budget_sections(budget)
    left_out = [
        (camera, entry.view, "all" if entry.point is None else str(entry.point), entry.reason)
        for camera, entry in fit.rejected
    ]
    if left_out:
        header = ("camera", "view", "point", "reason")
        sections.append(Section("Left out", header=header, rows=left_out))
    sections.append(Section("How this was computed", rows=_facts(fit, rig, origin)))
    formats = {name: data.pose_format for name, data in rig.cameras.items()}
    forms = [
        (f"{name}: {title}", texts)
        for name, calibration in fit.calibrations.items()
        for title, texts in calibration_forms(calibration, formats[name])
    ]
    write_story(path, page_title(origin), rig_summary(fit, held_out), sections, forms)


def _joint_section(fit: RigFit, used: Rig, poses: Sequence[PoseUncertainty]) -> Section:
    """Return the section of all cameras: their frames, their uncertainty by cause, their errors."""
    errors = {
        name: reprojection_errors(calibration, used.cameras[name])
        for name, calibration in fit.calibrations.items()
    }
    figures = [
        StoryFigure(
            "Where the cameras are.",
            "Pyramids open along the optical axes; axes are red (x), green (y) and blue (z).",
            plots.camera_mounts(fit),
        ),
        StoryFigure(
            "State by state.",
            "A state in which all cameras have large errors has a wrong pose.",
            plots.view_errors(used, errors),
        ),
    ]
    if any(pose.translation > 0.0 for pose in poses) and np.isfinite(fit.covariance).all():
        figures.insert(
            1,
            StoryFigure(
                "What limits each pose.",
                "Shares of the variance by cause, with standard deviations. More points reduce the "
                "part of the pixels; more states of the robot, every part. Cameras on one mount "
                "share the robot's error, so that it hardly affects their relative pose. The sizes "
                "of the errors are estimates, too.",
                plots.pose_uncertainties(poses),
            ),
        )
    return Section("All cameras", figures=figures)


def _budget_sections(budget: RigErrorBudget) -> list[Section]:
    """Return the sections of the causes: of each camera's error, and of each pose's uncertainty."""
    return [
        Section(
            "Where the error comes from",
            "RMS errors of each camera's chain without correction, px, by cause.",
            header=("cause", *budget.cameras),
            rows=rig_budget_rows(budget),
        ),
        Section(
            "What to do", rows=[(name, entry.summary) for name, entry in budget.cameras.items()]
        ),
        Section(
            "What limits each pose",
            "Standard deviations of all axes together.",
            header=POSE_CAUSE_HEADINGS,
            rows=pose_cause_rows(budget),
        ),
    ]


def _camera_section(
    fit: RigFit, used: Rig, name: str, held_out: Mapping[str, HeldOutErrors] | None
) -> Section:
    """Return the section of one camera: predictions over its pictures, errors by view."""
    data, calibration = used.cameras[name], fit.calibrations[name]
    errors = {"fitted": reprojection_errors(calibration, data)}
    if held_out is not None:
        errors["held-out"] = held_out[name].errors
    figures = [
        StoryFigure(f"Predicted points, view {view}.", caption, picture)
        for view, caption, picture in prediction_overlays(
            data, ErrorSummary(name, errors["fitted"], None), calibration
        )
    ]
    figures.append(
        StoryFigure(
            "View by view.",
            "A view that stands out for one camera has a bad detection or a wrong pairing; one "
            "that stands out for all cameras has a wrong pose.",
            plots.view_errors(data, errors),
        )
    )
    residuals = np.where(np.asarray(data.visible)[..., None], fit.residuals[name], np.nan)
    if np.isfinite(residuals).any():
        figures.append(
            StoryFigure(
                "Over the image.",
                "Arrows that agree with their neighbours in all views mean that the lens model is "
                "too simple.",
                plots.residual_vectors(data, residuals),
            )
        )
    return Section(f"Camera {name}", figures=figures)


def _facts(fit: RigFit, rig: Rig, origin: Origin | None) -> list[tuple[str, str]]:
    """Return rows of name and text on the data, the command and the fit."""
    facts = origin_facts(origin)
    facts.append(("robot states", f"{len(fit.view_ids)}"))
    targets = dict.fromkeys(rig.targets.values())
    for target in targets:
        seeing = ", ".join(name for name in rig.cameras if rig.targets[name] == target)
        name = f"target {target}" if len(targets) > 1 else "target"
        facts.append((name, f"seen by {seeing}"))
    for arm in fit.bases:
        moved = ", ".join(name for name, moving in fit.arms.items() if arm in arms_of(moving))
        facts.append((f"arm {arm}", f"of the cameras {moved}"))
    facts += [(f"depth sensor of {name}", sensor.described) for name, sensor in fit.sensors.items()]
    facts.append(("joint fit", fit.result.message))
    for arm, estimate in fit.noise_estimates.items():
        robot = arm if fit.bases else "the robot"
        facts.append((f"model of {robot}'s error", estimate.name))
    return facts
