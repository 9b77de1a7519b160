"""Make the model of an object by scripted clicks, which imitate a person at the editor.

In every picture that shows a vertex the script "clicks" the nearest detected corner, or the pixel
itself where there is none, through the same `ModelSession` as the page of the editor.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..calibration import Calibration
from ..editor import ModelSession
from ..evaluation import CalibrationEstimate
from ..io import load_object_model, save_object_model
from ..modeling import ObjectModel, find_symmetry
from ..robots import Command

SNAP_DISTANCE = 1.0
"""Largest distance of a detected corner from the true pixel for a click to snap to it, px."""

CLICK_SIGMA = 0.3
"""Standard deviation of the clicks, px."""


class SeenObject(NamedTuple):
    """An object as a person sees it in pictures.

    Attributes:
        pixels: where each vertex is, px.
        visible: whether it is seen there.
        faces: loops of vertices; a face is added if all its vertices can be clicked.
    """

    pixels: Float[np.ndarray, "views vertices 2"]
    visible: Bool[np.ndarray, "views vertices"]
    faces: Sequence[Sequence[int]]
    name: str


def model_by_clicks(
    calibration: Calibration,
    estimate: CalibrationEstimate | None,
    command: Command,
    pictures: Sequence[UInt8[np.ndarray, "rows columns"]],
    seen: SeenObject,
    path: Path,
) -> ObjectModel:
    """Return the model that a person would make of an object by clicking its corners.

    Args:
        calibration: of the pictures.
        estimate: fit with the calibration's covariance, for the covariance of the vertices.
        command: reported poses of the robot, one for each view.
        seen: what a person sees in the pictures.
        path: of the model's file, which includes the symmetry.

    Raises:
        ValueError: too few vertices can be clicked in at least two pictures, so that no face is
            complete.
    """
    seen_pixels, visible = seen.pixels, seen.visible
    names = [f"view {1 + k}" for k in range(len(pictures))]
    with ModelSession(
        calibration,
        command,
        list(pictures),
        names,
        path,
        covariance=estimate,
        click_sigma=CLICK_SIGMA,
    ) as session:
        # Detected corners, to which the editor's page snaps too.
        corners = {picture_name: session.features(picture_name).corners for picture_name in names}
        points: dict[int, int] = {}
        for vertex in range(seen_pixels.shape[1]):
            clicks = []
            for view, picture_name in enumerate(names):
                distance = np.linalg.norm(corners[picture_name] - seen_pixels[view, vertex], axis=1)
                if not visible[view, vertex]:
                    continue
                # Where no corner was detected a person clicks by eye, on a whole pixel.
                snaps = distance.min(initial=np.inf) < SNAP_DISTANCE
                pixel = corners[picture_name][int(np.argmin(distance))] if snaps else None
                by_eye = np.rint(seen_pixels[view, vertex])
                clicks.append((picture_name, (by_eye if pixel is None else pixel).tolist()))
            point = None
            # Two clicks make a point in space; further ones improve it.
            for picture_name, pixel in clicks if len(clicks) > 1 else ():
                point = session.click(picture_name, pixel, point)
            if point is not None:
                points[vertex] = point
        complete = [loop for loop in seen.faces if all(v in points for v in loop)]
        if not complete:
            raise ValueError(
                f"{seen.name}: {len(points)} vertices were clicked, no face is complete"
            )
        for loop in complete:
            session.add_face([points[v] for v in loop])
        session.change({"do": "rename", "name": seen.name})
        saved = session.save()
    model = load_object_model(saved)
    model = dataclasses.replace(model, symmetry=find_symmetry(model))
    # The session writes a symmetry only if a person confirmed it, but the file needs it.
    save_object_model(model, saved)
    return model
