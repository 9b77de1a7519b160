"""Draw objects: edge maps with features, wireframes over pictures, and models in space.

Modules on objects are imported on first use: a calibration's report needs none, and would take a
quarter longer to import.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ..cameras import Camera
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from .figures import BLUE, RED, PlotFigure, space_axes

if TYPE_CHECKING:
    from ..features import PictureEvidence
    from ..localization import PredictedView
    from ..modeling import ObjectModel

EDGE_COLOUR, SEGMENT_COLOUR, CORNER_COLOUR = (150, 150, 150), (120, 220, 60), (40, 120, 255)
"""Colours of edge points, segments and corners: blue, green, red."""

WIREFRAME_COLOURS = ((255, 160, 30), (60, 190, 255), (200, 90, 220), (90, 220, 90))
"""Colours of wireframes, one after the other: blue, green, red."""

SHIFT = 4
"""Number of fractional bits in the coordinates of OpenCV's drawing."""

SAMPLES = 600
"""Number of points drawn along the edges of a wireframe."""


def edge_map(evidence: "PictureEvidence") -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the edge points of a picture with its segments and corners."""
    width, height = evidence.features.image_size
    canvas = np.full((height, width, 3), 18, np.uint8)
    # Whole pixels are enough for points; lines are drawn with fractions.
    columns, rows = np.rint(evidence.edge_points.pixels).astype(int).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    canvas[rows[inside], columns[inside]] = EDGE_COLOUR
    for ends in evidence.features.segments:
        a, b = (_fixed(end) for end in ends)
        cv2.line(canvas, a, b, SEGMENT_COLOUR, 2, cv2.LINE_AA, SHIFT)
    for corner in evidence.features.corners:
        cv2.circle(canvas, _fixed(corner), 5 << SHIFT, CORNER_COLOUR, 2, cv2.LINE_AA, SHIFT)
    if evidence.grey is None or evidence.scale == 1.0:
        return canvas
    # Shown at the size of the picture as it was given.
    height, width = evidence.grey.shape
    return cv2.resize(canvas, (width, height)).astype(np.uint8)


def with_wireframes(
    picture: UInt8[np.ndarray, "rows columns"] | None,
    camera: Camera,
    camera_from_world: Float[np.ndarray, "4 4"],
    objects: Sequence[tuple["ObjectModel", Float[np.ndarray, "4 4"]]],
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return a picture with the visible edges of objects drawn over it.

    Args:
        picture: grey; None draws on a dark background.
        objects: models and their poses `world_from_object`.
    """
    from ..localization import Wireframe

    if picture is None:
        width, height = camera.image_size
        canvas = np.full((height, width, 3), 18, np.uint8)
    else:
        canvas = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    for k, (model, pose) in enumerate(objects):
        wireframe, pose_in_camera = Wireframe.of(model, SAMPLES), camera_from_world @ pose
        predicted = _compiled_prediction()(wireframe, camera, to_device(pose_in_camera))
        pixels, visible = np.asarray(predicted.samples), np.asarray(predicted.sample_visible)
        # Half a step to either side, so that neighbours meet.
        steps = np.asarray(predicted.directions) * 0.5 * np.asarray(predicted.sample_px)[:, None]
        # Each sample is drawn as a short piece of its edge.
        for pixel, step in zip(pixels[visible], steps[visible], strict=True):
            a, b = _fixed(pixel - step), _fixed(pixel + step)
            colour = WIREFRAME_COLOURS[k % len(WIREFRAME_COLOURS)]
            cv2.line(canvas, a, b, colour, 2, cv2.LINE_AA, SHIFT)
    return canvas


def cropped(
    picture: np.ndarray, pixels: Float[np.ndarray, "points 2"], margin: float = 60.0
) -> np.ndarray:
    """Return the part of a picture around the given pixels."""
    height, width = picture.shape[:2]
    known = pixels[np.isfinite(pixels).all(axis=1)]
    if not len(known):
        return picture
    low = np.clip(np.floor(known.min(axis=0) - margin), 0, [width - 2, height - 2]).astype(int)
    high = np.clip(np.ceil(known.max(axis=0) + margin), low + 1, [width, height]).astype(int)
    return picture[low[1] : high[1], low[0] : high[0]]


@functools.cache
def _compiled_prediction() -> "Callable[..., PredictedView]":
    """Return the prediction of a view, compiled at its first use."""
    from ..localization import predict_view

    return compiled(predict_view)


def _fixed(pixel: np.ndarray) -> tuple[int, int]:
    """Return a pixel in the fixed-point numbers of OpenCV's drawing."""
    u, v = np.rint(np.asarray(pixel) * (1 << SHIFT)).astype(int)
    return int(u), int(v)


def object_model_3d(model: "ObjectModel") -> PlotFigure:
    """Draw the edges of an object model and the places of its grasps, in its own frame, mm."""
    figure = PlotFigure(figsize=(5.0, 4.2), layout="constrained")
    axes = space_axes(figure, "mm")
    for edge in model.edges:
        axes.plot(*(1e3 * model.vertices[edge]).T, color=BLUE)
    for grasp in model.grasps:
        place = 1e3 * np.asarray(grasp.object_from_tool)[:3, 3]
        axes.scatter(*place, color=RED, label=grasp.name or "grasp")
    axes.set_aspect("equal")
    if model.grasps:
        axes.legend(frameon=False)
    return figure
