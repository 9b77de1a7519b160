"""Draw the plots of the report as matplotlib figures."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from ..calibration import Calibration
from ..dataset import Dataset
from ..targets import StackedTarget
from .tables import ErrorSummary

# The palette of Okabe and Ito, which colour-blind readers can distinguish.
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#777777"
COLOURS = {"staged": ORANGE, "joint": BLUE}


def _colour(name: str, index: int) -> str:
    """Return the colour of a method: its own, or one by its place among the others."""
    return COLOURS.get(name) or (BLUE, ORANGE, GREEN, RED, GREY)[index % 5]


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure with a single plot, of a width and a height in inches."""
    # `Figure` itself, not pyplot: it needs no display, and leaves a caller's own figures alone.
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def prediction_overlay(
    data: Dataset, view: int, picture: np.ndarray, calibration: Calibration
) -> Figure:
    """Draw predicted centres as crosses over a real picture, as in Fig. 1 of the paper.

    Args:
        data: data set with the detected points.
        view: index of the view.
        picture: grey picture, `(h, w)`; for a `StackedTarget`, the one at its first height.
        calibration: calibration that predicts the points.
    """
    target = data.target
    point_slice = slice(len(target.board.points) if isinstance(target, StackedTarget) else None)
    figure, axes = _figure(7.5, 5.8)
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255)
    predicted, valid = calibration.project(data.command, data.points)
    u, v = np.asarray(predicted)[view, point_slice][np.asarray(valid)[view, point_slice]].T
    axes.plot(u, v, "+", color=RED, markersize=9, markeredgewidth=1.2, label="predicted")
    measured = np.asarray(data.pixels)[view, point_slice][
        np.asarray(data.visible)[view, point_slice]
    ]
    axes.plot(*measured.T, ".", color=BLUE, markersize=3, label="measured")
    # A target with several heights may have been detected only at others than the picture's.
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


def error_histogram(rows: Sequence[ErrorSummary]) -> Figure:
    """Draw histograms of the reprojection errors, px, as in Fig. 7 of the paper."""
    figure, axes = _figure(7.0, 3.6)
    finite = [row.reprojection_errors.px[np.isfinite(row.reprojection_errors.px)] for row in rows]
    # The 99.5th percentile limits the axis, so that a few outliers do not compress the histogram.
    limit = max(float(np.percentile(values, 99.5)) for values in finite if values.size)
    bins = np.linspace(0.0, limit, 40).tolist()
    for k, (row, values) in enumerate(zip(rows, finite, strict=True)):
        colour = _colour(row.name, k)
        axes.hist(values, bins, alpha=0.35, color=colour)
        axes.hist(values, bins, histtype="step", color=colour, label=row.name)
        axes.axvline(row.reprojection_errors.mean, color=colour, linestyle="--", linewidth=1)
    axes.set_xlabel("reprojection error (px); dashed: mean")
    axes.set_ylabel("points")
    axes.legend(frameon=False)
    return figure


def residual_vectors(data: Dataset, residuals: np.ndarray) -> Figure:
    """Draw the residuals over the image as arrows, magnified so that they are visible."""
    figure, axes = _figure(7.0, 5.2)
    visible = np.asarray(data.visible) & np.isfinite(residuals).all(axis=-1)
    positions, vectors = np.asarray(data.pixels)[visible], residuals[visible]
    # An arrow of RMS length becomes 3 % of the picture's width.
    rms_length = float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1)))) or 1.0
    width, height = data.image_size
    magnification = 0.03 * width / rms_length
    # At most 2500 arrows, drawn at random, remain distinguishable.
    rng = np.random.default_rng(0)
    sample = rng.permutation(len(positions))[:2500]
    lengths = np.linalg.norm(vectors, axis=1)
    # The residual is measured minus predicted: an arrow points away from the prediction.
    arrows = axes.quiver(
        *positions[sample].T,
        *(magnification * vectors[sample]).T,
        lengths[sample],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        cmap="viridis",
        width=0.0018,
    )
    # Without a limit, a few outliers would give all other arrows the same colour.
    arrows.set_clim(0.0, float(np.percentile(lengths, 98)) or 1.0)
    figure.colorbar(arrows, ax=axes, label="reprojection error (px)", shrink=0.85, extend="max")
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal")
    axes.set_xlabel("u (px)")
    axes.set_ylabel("v (px)")
    axes.set_title(f"arrows enlarged {magnification:.0f} times", fontsize=10)
    return figure


def view_errors(data: Dataset, rows: Sequence[ErrorSummary]) -> Figure:
    """Draw the RMS reprojection error of every view as bars, px, which exposes outlying views."""
    figure, axes = _figure(max(5.0, 0.35 * data.view_count + 2.0), 3.4)
    positions = np.arange(data.view_count)
    for k, row in enumerate(rows):
        # The bars of a view stand side by side, centred on its position.
        offset = (k - 0.5 * (len(rows) - 1)) * 0.38
        heights = np.nan_to_num(row.reprojection_errors.rms_per_view)
        axes.bar(positions + offset, heights, 0.36, color=_colour(row.name, k), label=row.name)
    axes.set_xticks(positions, data.view_ids, rotation=90 if data.view_count > 20 else 0)
    axes.set_xlabel("view")
    axes.set_ylabel("RMS (px)")
    axes.legend(frameon=False)
    return figure


def camera_poses_3d(data: Dataset, calibration: Calibration) -> Figure:
    """Draw the cameras and the target in the target's frame, m; cameras of unused views are red."""
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    axes: Axes3D = figure.add_subplot(projection="3d")  # pyright: ignore[reportAssignmentType]
    world_from_camera = np.linalg.inv(calibration.camera_from_world_matrices(data.command))
    centres, rotations = world_from_camera[:, :3, 3], world_from_camera[:, :3, :3]
    visible = np.asarray(data.visible)
    target = np.asarray(data.points)[visible]
    # Every target point once, although most views show it; equal to a micrometre is the same point.
    target = target[np.unique(np.round(target, 6), axis=0, return_index=True)[1]]
    axes.scatter(*target.T, s=3, color=GREY, depthshade=False)
    used = np.asarray(visible.any(axis=1))
    # Cameras are drawn in proportion to their median distance from the target.
    length = 0.18 * float(np.median(np.linalg.norm(centres - target.mean(axis=0), axis=1)))
    for centre, rotation, view, is_used in zip(
        centres, rotations, data.view_ids, used, strict=True
    ):
        _frustum(axes, centre, rotation, calibration, length, BLUE if is_used else RED)
        axes.text(float(centre[0]), float(centre[1]), float(centre[2]), f" {view}", fontsize=7)
    for axis, colour in zip(np.eye(3), (RED, GREEN, BLUE), strict=True):
        axes.plot(*np.stack([np.zeros(3), length * axis]).T, color=colour, linewidth=2)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_zlabel("z (m)")
    if centres[:, 2].mean() < 0.0:
        axes.invert_zaxis()  # the target's z points away from the cameras: keep them on top
        axes.invert_yaxis()
    return figure


def error_by_views(
    chosen_errors: np.ndarray, random_errors: np.ndarray, unit: str = "px"
) -> Figure:
    """Draw the expected error against the number of views, for chosen and for random views.

    Args:
        chosen_errors: expected error after one chosen view, after two, and so on; infinite where
            the views leave a parameter undetermined.
        random_errors: the same for random orders of the views, `(orders, views)`.
        unit: unit of the error.
    """
    figure, axes = _figure(6.5, 3.8)
    view_counts = np.arange(1, 1 + random_errors.shape[1])
    # "nearest" takes one of the values: interpolation between infinite values gives NaN.
    low, median, high = np.quantile(random_errors, (0.05, 0.5, 0.95), axis=0, method="nearest")
    finite = np.isfinite(high)
    axes.fill_between(
        view_counts[finite], low[finite], high[finite], color=GREY, alpha=0.25, linewidth=0
    )
    axes.plot(view_counts[finite], median[finite], color=GREY, label="random, 5 to 95 % of draws")
    view_counts, finite = np.arange(1, 1 + len(chosen_errors)), np.isfinite(chosen_errors)
    axes.plot(
        view_counts[finite], chosen_errors[finite], "o-", color=BLUE, markersize=4, label="chosen"
    )
    axes.set_yscale("log")
    axes.set_xlabel("views")
    axes.set_ylabel(f"expected error ({unit})")
    axes.legend(frameon=False)
    return figure


def _frustum(
    axes: Axes,
    centre: np.ndarray,
    rotation: np.ndarray,
    calibration: Calibration,
    length: float,
    colour: str,
) -> None:
    """Draw a camera as a pyramid from its centre to the corners of its image, `length` m deep.

    Args:
        axes: 3D plot to draw in.
        centre: `(3,)` camera centre in the target's frame, m.
        rotation: `(3, 3)` rotation from the camera's to the target's frame.
        calibration: calibration with the camera's intrinsics.
        length: depth of the pyramid, m.
        colour: colour of the lines.
    """
    camera = calibration.camera
    width, height = camera.image_size
    # Corners at depth 1, without distortion: ((u - u0) / alpha_u, (v - v0) / alpha_v, 1).
    x = np.array([0.0, width, width, 0.0]) - float(camera.u0)
    y = np.array([0.0, 0.0, height, height]) - float(camera.v0)
    corners = np.stack([x / float(camera.alpha_u), y / float(camera.alpha_v), np.ones(4)], axis=1)
    corners = centre + length * corners @ rotation.T
    axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=colour, linewidth=0.8)
    for corner in corners:
        axes.plot(*np.stack([centre, corner]).T, color=colour, linewidth=0.5)
