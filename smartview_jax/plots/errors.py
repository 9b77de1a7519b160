"""Draw errors of pixels and tracked poses: how large, in which views and directions."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from ..dataset import Dataset, Rig
from ..evaluation import ReprojectionErrors
from ..joint import Influence, PoseFit
from .figures import BLUE, GREY, PlotFigure, method_colour, picture_axes, single_plot

MAX_VIEW_LABELS = 60
"""Largest number of views whose names are printed side by side under a plot."""

MAX_LABEL_CHARACTERS = 90
"""Largest number of characters that fit side by side under a plot."""


def error_histogram(errors: Mapping[str, ReprojectionErrors]) -> PlotFigure:
    """Draw histograms of the reprojection errors, px, as in Fig. 7 of the paper.

    Args:
        errors: reprojection errors by the name of the calibration that made them.

    Raises:
        ValueError: no error is finite.
    """
    figure, axes = single_plot(4.7, 3.3)
    if not any(e.values.size for e in errors.values()):
        raise ValueError("errors: no point was predicted, so there is nothing to draw")
    # The 99.5th percentile limits the axis, so that a few outliers do not compress the histogram.
    limit = max(float(np.percentile(e.values, 99.5)) for e in errors.values() if e.values.size)
    bins = np.linspace(0.0, limit, 40).tolist()
    for k, (name, method_errors) in enumerate(errors.items()):
        colour = method_colour(name, k)
        # A light area for the shape, and a line that stays visible where two overlap.
        axes.hist(method_errors.values, bins, alpha=0.35, color=colour)
        axes.hist(method_errors.values, bins, histtype="step", color=colour, label=name)
        axes.axvline(method_errors.mean, color=colour, linestyle="--", linewidth=1)
    axes.set_xlabel("reprojection error (px); dashed: mean")
    axes.set_ylabel("points")
    axes.legend(frameon=False)
    return figure


def view_errors(data: Dataset | Rig, errors: Mapping[str, ReprojectionErrors]) -> PlotFigure:
    """Draw the RMS reprojection error of every view as bars, px, which exposes outlying views.

    Args:
        data: the views. Of a rig, the bars of a state of the robot stand side by side: if all are
            high, the robot's pose is wrong, and if one is, the picture.
        errors: reprojection errors by the name of the calibration that made them; of a rig, by the
            name of the camera.
    """
    figure, axes = single_plot(9.6, 3.2)
    width = 0.8 / max(len(errors), 1)
    for k, (name, method_errors) in enumerate(errors.items()):
        positions = np.arange(data.view_count)
        if isinstance(data, Rig):
            positions = data.state_index[name]
        # The bars of a view stand side by side, centred on its position.
        offset = (k - 0.5 * (len(errors) - 1)) * width
        heights = np.nan_to_num(method_errors.rms_per_view)
        axes.bar(
            positions + offset, heights, 0.95 * width, color=method_colour(name, k), label=name
        )
    name_views(axes, data.view_ids)
    axes.set_ylabel("RMS (px)")
    figure.legend(loc="outside upper right", ncols=max(len(errors), 1), frameon=False)
    return figure


def name_views(axes: Axes, view_ids: Sequence[str]) -> None:
    """Write the names of views, drawn at 0, 1, ..., under a plot."""
    # To avoid overlap, only every second, third, ... of many views is labelled.
    count = len(view_ids)
    step = -(-count // MAX_VIEW_LABELS)
    crowded = max(map(len, view_ids)) * count / step > MAX_LABEL_CHARACTERS
    axes.set_xticks(
        np.arange(count)[::step], view_ids[::step], rotation=90 if crowded else 0, fontsize=9
    )
    axes.set_xlim(-0.7, count - 0.3)
    axes.set_xlabel("view")


def residual_vectors(data: Dataset, residuals: np.ndarray) -> PlotFigure:
    """Draw the residuals over the image as arrows, magnified so that they are visible.

    Args:
        residuals: measured minus predicted pixels, `(views, points, 2)`, as in
            `JointFit.residuals`; values that are not finite are left out.

    Raises:
        ValueError: no residual is finite.
    """
    figure, axes = single_plot(9.6, 6.6)
    visible = np.asarray(data.visible) & np.isfinite(residuals).all(axis=-1)
    if not visible.any():
        raise ValueError("residuals: none is finite, so there is nothing to draw")
    positions, vectors = np.asarray(data.pixels)[visible], residuals[visible]
    # An arrow of RMS length becomes 3 % of the picture's width.
    rms_length = float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1)))) or 1.0
    magnification = 0.03 * data.image_size[0] / rms_length
    # At most 2500 arrows, chosen at random, remain distinguishable.
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
    picture_axes(axes, data.image_size)
    axes.set_title(f"arrows enlarged {magnification:.0f} times", fontsize=10)
    return figure


def view_influence(influence: Influence, view_ids: Sequence[str], path: str) -> PlotFigure:
    """Draw how much the estimate would change without each view, in standard deviations.

    Args:
        influence: result of `sv.view_influence`.
        path: of the parameters, such as `camera_from_tool`.
    """
    figure, axes = single_plot(9.6, 2.8)
    axes.bar(view_ids, influence.max_standardised_change(path), color=BLUE)
    axes.set(xlabel="view left out", ylabel="standard deviations")
    axes.set_title(f"change of {path}", fontsize=10)
    axes.tick_params(axis="x", labelrotation=90 if len(view_ids) > MAX_VIEW_LABELS / 2 else 0)
    return figure


def error_by_views(
    chosen_errors: np.ndarray, random_errors: np.ndarray, unit: str = "px"
) -> PlotFigure:
    """Draw the expected error against the number of views, for chosen and for random views.

    Args:
        chosen_errors: expected error after one chosen view, after two, and so on; infinite where
            the views leave a parameter undetermined.
        random_errors: the same for random orders of the views, `(orders, views)`.
        unit: unit of the error.
    """
    figure, axes = single_plot(6.5, 3.8)
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
    # Errors are read as plain numbers: 0.5, not 5 x 10^-1.
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("views")
    axes.set_ylabel(f"expected error ({unit})")
    axes.legend(frameon=False)
    return figure


def pose_errors(fit: PoseFit) -> PlotFigure:
    """Draw the distance and the angle of each tracked pose from its prediction as bars.

    Pairs that the fit left out are grey. The axes are logarithmic, since a wrong pair may be a
    thousand times as far away as a right one.
    """
    figure = PlotFigure(figsize=(9.6, 4.4), layout="constrained")
    used = fit.used_views
    positions = np.arange(len(fit.view_ids))
    axes = figure.subplots(2, 1, sharex=True)
    units = (("distance (mm)", 1e3), ("angle (degrees)", np.rad2deg(1.0)))
    for row, (label, unit), errors in zip(axes, units, fit.pose_errors.T, strict=True):
        for views, colour, name in ((used, BLUE, "used"), (~used, GREY, "left out")):
            if views.any():
                row.bar(positions[views], unit * errors[views], 0.8, color=colour, label=name)
        row.set_yscale("log")
        row.set_ylabel(label)
    name_views(axes[-1], fit.view_ids)
    axes[-1].set_xlabel("pair")
    if not used.all():
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False)
    return figure
