"""Draw what cameras saw, and their poses."""

import numpy as np
from mpl_toolkits.mplot3d import Axes3D

from ..calibration import Calibration
from ..dataset import Dataset
from ..targets import StackedTarget
from .camera_scene import camera_scene
from .figures import BLUE, GREEN, GREY, RED, PlotFigure, single_plot


def prediction_overlay(
    data: Dataset, view: int, picture: np.ndarray, calibration: Calibration
) -> PlotFigure:
    """Draw predicted centres as crosses over a real picture, as in Fig. 1 of the paper.

    Args:
        data: data set with the detected points.
        view: index of the view.
        picture: grey picture, `(h, w)`; for a `StackedTarget`, at the first height with a detected
            point, as in `data.pictures`.
        calibration: calibration that predicts the points.
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
    axes: Axes3D = figure.add_subplot(projection="3d")  # pyright: ignore[reportAssignmentType]
    axes.scatter(*scene.target.T, s=3, color=GREY, depthshade=False)
    for view, name in enumerate(scene.view_ids):
        centre, corners = scene.centres[view], scene.corners[view]
        colour = BLUE if scene.used[view] else RED
        # The picture's border, then a line from the camera's centre to each of its corners.
        axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=colour, linewidth=0.8)
        for corner in corners:
            axes.plot(*np.stack([centre, corner]).T, color=colour, linewidth=0.5)
        x, y, z = (float(number) for number in centre)
        axes.text(x, y, z, f" {name}", fontsize=7)
    for axis, colour in zip(np.eye(3), (RED, GREEN, BLUE), strict=True):
        axes.plot(*np.stack([np.zeros(3), scene.axis_length * axis]).T, color=colour, linewidth=2)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_zlabel("z (m)")
    if scene.camera_side_is_below:
        axes.invert_zaxis()  # keeps the cameras on top
        axes.invert_yaxis()
    return figure
