"""Draw how far tracked poses are from their predictions, pair by pair."""

import numpy as np

from ..joint import PoseFit
from .errors import name_views
from .figures import BLUE, GREY, PlotFigure


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
