"""Present the results of a localisation: a table, and one HTML page with the pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from ..geometry import host_transforms, pose_codec
from ..modeling import AnyCalibration, SeenViews
from ..plots import with_wireframes
from .story import Section, StoryFigure, write_story

if TYPE_CHECKING:
    from ..localization import Localization, Localizations

LOCALIZATION_HEADINGS = (
    "object",
    "verdict",
    "x,y,z m, yaw,pitch,roll degrees",
    "+- mm",
    "+- degrees",
    "edges found",
    "off by px",
)
"""The headings of `localization_rows`; the intervals are 95 % intervals."""


def localization_rows(localizations: "Sequence[Localization]") -> list[list[str]]:
    """Return a row for each object: verdict, pose, its uncertainty, and the evidence."""
    rows = []
    for obj in localizations:
        std, evidence = np.sqrt(np.diagonal(obj.covariance)), obj.verdict.evidence
        # 1.96 standard deviations are 95 % of a Gaussian; the worst of three axes is shown.
        rows.append(
            [
                obj.name,
                obj.verdict.decision,
                object_pose_text(obj),
                f"{1.96e3 * std[:3].max():.2f}",
                f"{1.96 * np.rad2deg(std[3:].max()):.3f}",
                f"{evidence.explained:.0%}",
                f"{evidence.edge_rms:.2f}",
            ]
        )
    return rows


def object_pose_text(obj: "Localization") -> str:
    """Return `world_from_object` in the format of `smartview grasp --object-pose`."""
    codec = pose_codec("yaw_pitch_roll")
    numbers = codec.encode(host_transforms(obj.world_from_object), angle_unit="deg")
    # Micrometres, and a ten-thousandth of a degree, which is 0.2 micrometres at 0.1 m.
    return ",".join([f"{x:.6f}" for x in numbers[:3]] + [f"{x:.4f}" for x in numbers[3:]])


def localization_verdict(localizations: "Localizations") -> str:
    """Return the result in a sentence."""
    if not localizations.accepted:
        return "Nothing was found for certain."
    names = ", ".join(obj.name for obj in localizations.accepted)
    return f"Found for certain in {len(localizations.pictures)} pictures: {names}."


def write_localization_page(
    path: Path,
    title: str,
    calibration: AnyCalibration,
    localizations: "Localizations",
    pictures: Sequence[UInt8[np.ndarray, "rows columns"]],
    view_ids: Sequence[str],
) -> None:
    """Write the results as a page: the table, the reasons, and wireframes over the pictures."""
    seen = SeenViews.of(calibration, localizations.command)
    sections = [
        Section(
            "What was found",
            "95 % intervals, from the pictures' noise and the calibration's covariance.",
            header=LOCALIZATION_HEADINGS,
            rows=localization_rows(localizations),
        )
    ]
    if localizations.messages:
        rows = [[text] for text in localizations.messages]
        sections.append(Section("What was not found", rows=rows))
    # Open objects are drawn too: a person sees at once whether they are right.
    for decision in ("accepted", "open"):
        results = [result for result in localizations if result.verdict.decision == decision]
        objects = [(result.model, np.asarray(result.world_from_object)) for result in results]
        if objects:
            figures = [
                StoryFigure(name, "", with_wireframes(picture, camera, pose, objects))
                for name, picture, camera, pose in zip(
                    view_ids, pictures, seen.cameras, seen.camera_from_world, strict=True
                )
            ]
            sections.append(Section(f"In the pictures: {decision}", figures=figures))
    write_story(path, title, localization_verdict(localizations), sections)
