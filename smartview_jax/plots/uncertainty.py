"""Draw the uncertainty of a calibration: over the picture, over the workspace, by parameter."""

from collections.abc import Sequence

import numpy as np

from ..calibration import Calibration
from ..evaluation import PictureUncertainty, WorkspaceUncertainty
from ..joint import JointFit, displayed_values_and_aspect, parameter_estimates
from .figures import BLUE, RED, PlotFigure, picture_axes, single_plot


def picture_uncertainty(uncertainty: PictureUncertainty) -> PlotFigure:
    """Draw `evaluation.picture_uncertainty`: the standard deviation of predicted pixels, px."""
    figure, axes = single_plot(4.7, 3.3)
    # The points are not a grid, because distortion has moved them.
    u, v = uncertainty.pixels.T
    contours = axes.tricontourf(u, v, uncertainty.std, levels=12)
    figure.colorbar(contours, ax=axes, label="standard deviation (px)", shrink=0.85)
    picture_axes(axes, uncertainty.image_size)
    axes.set_title(f"view {uncertainty.view_id}, at {uncertainty.depth:.2f} m", fontsize=10)
    return figure


def workspace_uncertainty(uncertainty: WorkspaceUncertainty) -> PlotFigure:
    """Draw `evaluation.workspace_uncertainty`: the standard deviation of a camera's aim, mm."""
    figure, axes = single_plot(4.7, 3.3)
    x, y = 1e3 * uncertainty.points[..., 0], 1e3 * uncertainty.points[..., 1]
    contours = axes.contourf(x, y, 1e3 * uncertainty.std, levels=12)
    figure.colorbar(contours, ax=axes, label="standard deviation (mm)", shrink=0.85)
    axes.set(aspect="equal", xlabel="x of the target (mm)", ylabel="y of the target (mm)")
    axes.set_title(f"seen from {uncertainty.distance:.2f} m", fontsize=10)
    return figure


def parameter_intervals(
    fit: JointFit, prefixes: Sequence[str], truth: Calibration | None = None
) -> PlotFigure:
    """Draw estimates of parameters with their 95 % intervals, and the true values if known.

    Args:
        prefixes: how the names of the parameters in each plot begin, such as
            `camera_from_tool.translation`.
        truth: the true calibration of a simulation, with the same parameters.

    Raises:
        ValueError: the fit estimated no parameter whose name begins so.
    """
    estimates = [e for e in parameter_estimates(fit) if e.half_width is not None]
    true_values = {} if truth is None else displayed_values_and_aspect(truth)
    figure = PlotFigure(figsize=(2.8 * max(len(prefixes), 1), 3.0), layout="constrained")
    for axes, prefix in zip(
        figure.subplots(1, len(prefixes), squeeze=False)[0], prefixes, strict=True
    ):
        chosen = [e for e in estimates if e.name.startswith(prefix)]
        if not chosen:
            raise ValueError(f"prefixes: no parameter that was estimated begins with {prefix!r}")
        # Zero is the nominal value of an arm's errors.
        axes.axhline(0.0, color="0.8", linewidth=1)
        labels = [e.name.removeprefix(prefix).strip(".") for e in chosen]
        values = np.array([e.value for e in chosen])
        half_widths = np.array([e.half_width for e in chosen], dtype=float)
        axes.errorbar(
            labels, values, half_widths, fmt="o", color=BLUE, capsize=3, label="estimated"
        )
        if true_values:
            true = [true_values[e.name][0] for e in chosen]
            axes.plot(labels, true, "x", color=RED, markersize=8, label="true")
        axes.set_title(prefix.replace("_", " "), fontsize=10)
        axes.set_ylabel(chosen[0].unit)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(frameon=False)
    return figure
