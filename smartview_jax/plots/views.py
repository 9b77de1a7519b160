"""Draw what cameras saw, and their poses."""

import numpy as np

from ..calibration import Calibration
from ..dataset import Dataset
from ..targets import StackedTarget
from .camera_scene import camera_scene
from .figures import (
    BLUE,
    GREY,
    RED,
    PlotFigure,
    draw_frame,
    draw_pyramid,
    single_plot,
    space_axes,
)


def prediction_overlay(
    data: Dataset, view: int, picture: np.ndarray, calibration: Calibration
) -> PlotFigure:
    """Draw predicted centres as crosses over a real picture, as in Fig. 1 of the paper.

    The picture is grey; of a `StackedTarget` it is `data.pictures`, at one height.
    """
    point_slice = _points_in_picture(data, view)
    figure, axes = single_plot(4.7, 4.0)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255)
    predicted, valid = calibration.project(data.command, data.points)
    u, v = np.asarray(predicted)[view, point_slice][np.asarray(valid)[view, point_slice]].T
    measured = np.asarray(data.pixels)[view, point_slice][
        np.asarray(data.visible)[view, point_slice]
    ]
    # Rings, so that a cross in the middle stays visible where both agree.
    axes.plot(
        *measured.T,
        "o",
        color=BLUE,
        fillstyle="none",
        markersize=6,
        markeredgewidth=1.0,
        label="measured",
    )
    axes.plot(u, v, "+", color=RED, markersize=6, markeredgewidth=0.9, label="predicted")
    # In the picture of an unused view nothing may have been found.
    if len(measured):
        # The picture is cropped to the measured points and a margin of 12 % of their extent.
        margin = 0.12 * float(np.ptp(measured, axis=0).max())
        low, high = measured.min(axis=0) - margin, measured.max(axis=0) + margin
        axes.set_xlim(max(low[0], -0.5), min(high[0], picture.shape[1] - 0.5))
        axes.set_ylim(min(high[1], picture.shape[0] - 0.5), max(low[1], -0.5))
    axes.set_title(f"view {data.view_ids[view]}")
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _points_in_picture(data: Dataset, view: int) -> slice:
    """Return the points of a target that are in `data.pictures[view]`: the points at one height."""
    if not isinstance(data.target, StackedTarget):
        return slice(None)
    count = len(data.target.board.points)
    # `argmax` finds the first height with a detected point; the first height if there is none.
    height = int(np.argmax(np.asarray(data.visible)[view].reshape(-1, count).any(axis=1)))
    return slice(height * count, (1 + height) * count)


def camera_poses_3d(data: Dataset, calibration: Calibration) -> PlotFigure:
    """Draw the cameras and the target in the target's frame, m; cameras of unused views are red."""
    scene = camera_scene(data, calibration)
    figure = PlotFigure(figsize=(7.0, 6.0), layout="constrained")
    axes = space_axes(figure, "m")
    axes.scatter(*scene.target.T, s=3, color=GREY, depthshade=False)
    for view, name in enumerate(scene.view_ids):
        colour = BLUE if scene.used[view] else RED
        draw_pyramid(axes, scene.centres[view], scene.corners[view], colour, 0.8)
        x, y, z = map(float, scene.centres[view])
        axes.text(x, y, z, f" {name}", fontsize=7)
    draw_frame(axes, np.eye(4), scene.axis_length)
    axes.set_aspect("equal")
    if scene.camera_side_is_below:
        axes.invert_zaxis()  # keeps the cameras on top
        axes.invert_yaxis()
    return figure
