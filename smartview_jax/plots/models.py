"""Draw an object model in space."""

from typing import TYPE_CHECKING

import numpy as np
from mpl_toolkits.mplot3d import Axes3D

from .figures import BLUE, RED, PlotFigure

if TYPE_CHECKING:
    from ..modeling import ObjectModel


def object_model_3d(model: "ObjectModel") -> PlotFigure:
    """Draw the edges of an object model and the places of its grasps, in its own frame, mm."""
    figure = PlotFigure(figsize=(5.0, 4.2), layout="constrained")
    axes: Axes3D = figure.add_subplot(projection="3d")  # pyright: ignore[reportAssignmentType]
    for edge in model.edges:
        axes.plot(*(1e3 * model.vertices[edge]).T, color=BLUE)
    for grasp in model.grasps:
        place = 1e3 * np.asarray(grasp.object_from_tool)[:3, 3]
        axes.scatter(*place, color=RED, label=grasp.name or "grasp")
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")
    axes.set_zlabel("z (mm)")
    axes.set_aspect("equal")
    if model.grasps:
        axes.legend(frameon=False)
    return figure
