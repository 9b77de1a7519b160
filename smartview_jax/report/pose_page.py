"""Write the report of a fit to tracked poses as one HTML page that contains its plots."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..dataset import PoseDataset
from ..evaluation import HeldOutPoses
from ..joint import PoseFit, estimate_groups, hand_eye_forms, pose_rms, tracked_pose_errors
from ..plots import pose_errors
from .next_steps import hand_eye_sentence
from .page import Origin, origin_facts, page_title
from .story import Section, StoryFigure, remarks_sections, write_story
from .tables import rejections, robot_error_row


def pose_error_rows(fit: PoseFit, held_out: HeldOutPoses | None) -> list[tuple[str, str, str]]:
    """Return a row for each kind of error of the tracked poses: its name, distance and angle."""
    kinds = [("fitted pairs, RMS", fit.rms)]
    if held_out is not None:
        kinds.append(("held-out pairs, RMS", held_out.rms))
    kinds.append(("noise of the tracker, per axis", fit.tracker_noise))
    if fit.drift is not None:
        kinds.append(("drift of the tracker from pose to pose, per axis", fit.drift.steps))
    if fit.noise is not None:
        robot = fit.noise.translation, fit.noise.rotation
        kinds.append(("noise of the robot, per axis", robot))
    rows = [
        (name, f"{1e3 * distance:.3g} mm", f"{np.rad2deg(angle):.3g} deg")
        for name, (distance, angle) in kinds
    ]
    if fit.sensor is not None and fit.sensor.across_std is not None:
        across, along = 1e3 * fit.sensor.across_std, 1e3 * fit.sensor.along_std
        rows.append(("noise of a measured point, across the ray", f"{across:.3g} mm", ""))
        rows.append(("noise of a measured point, along the ray", f"{along:.3g} mm", ""))
    return rows


def pose_fit_summary(fit: PoseFit, held_out: HeldOutPoses | None) -> str:
    """Return the result in a few sentences."""
    if not fit.result.converged:
        return f"The joint fit did not converge: {fit.result.message}."
    text = hand_eye_sentence(fit)
    if held_out is not None and np.isfinite(held_out.rms).all():
        distance, angle = held_out.rms
        text += (
            f" It predicts tracked poses that it never saw to {1e3 * distance:.3g} mm and "
            f"{np.rad2deg(angle):.3g} degrees RMS."
        )
    return text


def write_pose_page(
    path: Path,
    fit: PoseFit,
    data: PoseDataset,
    held_out: HeldOutPoses | None = None,
    origin: Origin | None = None,
    notes: Sequence[str] | None = None,
) -> None:
    """Write the report of a fit to tracked poses as an HTML page.

    Args:
        path: of the HTML file, which is written completely or not at all.
        held_out: result of `held_out_poses`; None if not computed.
        origin: data set and command of the page; None for a script's own data.
        notes: notes to print; None for the notes of `data`.
    """
    groups = [Section(heading, rows=rows) for heading, rows in estimate_groups(fit)]
    # The many numbers of an arm follow the errors.
    arm = [group for group in groups if group.title.startswith("arm")]
    sections = [group for group in groups if group not in arm]
    sections += remarks_sections(fit.warnings, data.notes if notes is None else notes)
    figure = StoryFigure(
        "Errors of the tracked poses.",
        "Distance and angle of each tracked pose from its prediction by the chain. A pair that "
        "stands out was mispaired or measured badly; pairs that get worse together point to the "
        "robot or to a tracker that was moved.",
        pose_errors(fit),
    )
    errors = pose_error_rows(fit, held_out)
    sections.append(Section("Errors", "", [figure], ("", "distance", "angle"), errors))
    if data.point_rms is not None:
        sections.append(_measured_points(data))
    left_out = rejections(fit, data)
    if left_out:
        sections.append(Section("Pairs left out", header=("pair", "reason"), rows=left_out))
    sections += arm
    sections.append(Section("How this was computed", rows=_facts(fit, data, origin)))
    write_story(
        path, page_title(origin), pose_fit_summary(fit, held_out), sections, hand_eye_forms(fit)
    )


def _measured_points(data: PoseDataset) -> Section:
    """Return how far the points of a depth sensor are from the target, by view."""
    distances = 1e3 * np.asarray(data.point_rms)
    rows = [
        (view, f"{distance:.3g} mm")
        for view, distance in zip(data.view_ids, distances, strict=True)
        if np.isfinite(distance)
    ]
    text = (
        "Distance of the measured points, with the sensor's bias removed, from the target at the "
        "pose that fits them best. A view that stands out was measured while something moved, or "
        "shows the target bent."
    )
    return Section("Measured points", text, header=("view", "RMS"), rows=rows)


def _facts(fit: PoseFit, data: PoseDataset, origin: Origin | None) -> list[tuple[str, str]]:
    """Return rows of name and text on the data, the command and the fit."""
    facts = origin_facts(origin)
    facts += [
        ("pairs", f"{fit.used_views.sum()} used of {data.view_count}"),
        ("mount", data.mount),
        ("joint fit", fit.result.message),
    ]
    if fit.sensor is not None:
        facts.append(("depth sensor", fit.sensor.described))
    if fit.noise_estimate is not None:
        facts.append(robot_error_row(fit.noise_estimate))
    if fit.calibration.robot_error is not None:
        errors = tracked_pose_errors(data, fit.calibration.uncorrected)
        distance, angle = pose_rms(errors[fit.used_views])
        facts.append(
            (
                "without the correction",
                f"{1e3 * distance:.3g} mm and {np.rad2deg(angle):.3g} degrees RMS: the error of a "
                "program that uses these transforms without the robot's correction",
            )
        )
    return facts
