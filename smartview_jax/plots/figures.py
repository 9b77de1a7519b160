"""Make figures that notebooks show by themselves, in one palette."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

# The palette of Okabe and Ito, which colour-blind readers can distinguish.
BLUE, ORANGE, GREEN, RED, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#777777"
_METHOD_COLOURS = {"staged": ORANGE, "joint": BLUE}

DOTS_PER_INCH = 110
"""Resolution at which figures are saved."""


class PlotFigure(Figure):
    """A matplotlib figure that a notebook shows, whether or not `pyplot` was ever imported.

    It belongs to no window and no global list, so that a program can draw thousands.
    """

    def png(self) -> bytes:
        """Return the figure as a PNG file."""
        buffer, dots_per_inch = io.BytesIO(), self.dpi
        self.dpi = DOTS_PER_INCH
        # The same picture as from `savefig`, which would lay out and draw every figure twice.
        FigureCanvasAgg(self).print_png(buffer)
        self.dpi = dots_per_inch
        return buffer.getvalue()

    def _repr_png_(self) -> bytes:
        return self.png()


def method_colour(name: str, index: int) -> str:
    """Return the colour of a method: a fixed one, or one by its index."""
    return _METHOD_COLOURS.get(name) or (BLUE, ORANGE, GREEN, RED, GREY)[index % 5]


def single_plot(width: float, height: float) -> tuple[PlotFigure, Axes]:
    """Return a figure with one plot, of a width and a height in inches."""
    figure = PlotFigure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def picture_axes(axes: Axes, image_size: tuple[int, int]) -> None:
    """Set the axes of a plot as in a picture: u to the right, v down, the whole picture."""
    width, height = image_size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set(aspect="equal", xlabel="u (px)", ylabel="v (px)")


def space_axes(
    figure: PlotFigure, unit: str, x: str = "x", place: tuple[int, int, int] = (1, 1, 1)
) -> Axes3D:
    """Return the axes of a plot in space, at a place as `Figure.add_subplot` takes it."""
    axes: Axes3D = figure.add_subplot(*place, projection="3d")  # pyright: ignore[reportAssignmentType]
    axes.set(xlabel=f"{x} ({unit})", ylabel=f"y ({unit})", zlabel=f"z ({unit})")
    return axes


def draw_frame(axes: Axes3D, pose: np.ndarray, length: float, factor: float = 1.0) -> None:
    """Draw the axes of a frame, x red, y green, z blue, from its pose in m times a factor."""
    origin = factor * pose[:3, 3]
    for axis, colour in zip(pose[:3, :3].T, (RED, GREEN, BLUE), strict=True):
        axes.plot(*np.stack([origin, origin + length * axis]).T, color=colour, linewidth=2)


def draw_pyramid(
    axes: Axes3D,
    centre: np.ndarray,
    corners: np.ndarray,
    colour: str,
    linewidth: float,
    label: str | None = None,
) -> None:
    """Draw a camera: the border of its picture, and a line from its centre to each corner."""
    axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=colour, linewidth=linewidth, label=label)
    for corner in corners:
        axes.plot(*np.stack([centre, corner]).T, color=colour, linewidth=linewidth / 1.5)
