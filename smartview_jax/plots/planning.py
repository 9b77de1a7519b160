"""Draw the expected benefit of more views."""

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from .figures import BLUE, GREY, PlotFigure, single_plot


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
