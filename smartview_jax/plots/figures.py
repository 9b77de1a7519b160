"""Make figures that notebooks show by themselves, in one palette."""

import io

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

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
