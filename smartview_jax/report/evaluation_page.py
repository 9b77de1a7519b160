"""Write how well calibrations predict pictures that they were not fitted to, as one HTML page."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..calibration import Calibration
from ..dataset import Dataset
from ..detection import read_picture
from . import plots
from .story import Section, StoryFigure, write_story
from .tables import ErrorSummary

DOTS_PER_INCH = 110
"""Resolution of the figures."""


def write_evaluation_page(
    path: Path,
    title: str,
    verdict: str,
    calibration: Calibration,
    data: Dataset,
    summaries: Sequence[ErrorSummary],
    rows: Sequence[Sequence[str]],
) -> None:
    """Write the figures of the paper's evaluation: Fig. 7, and Fig. 1 in two of the pictures.

    Args:
        path: of the HTML file.
        title: of the page.
        verdict: the result in a sentence.
        calibration: the first calibration, which predicts in the pictures.
        data: the views that are predicted.
        summaries: errors of every calibration.
        rows: the table, the names of the calibrations first.
    """
    histogram = StoryFigure(
        "Fig. 7",
        "Distances between measured and predicted points.",
        _picture(plots.error_histogram(summaries)),
    )
    by_view = StoryFigure(
        "RMS of each view.",
        "One that stands out is a wrong pose or a bad detection.",
        _picture(plots.view_errors(data, summaries)),
    )
    sections = [
        Section("Errors", header=rows[0], rows=rows[1:]),
        Section("Over all points", figures=[histogram]),
        Section("View by view", figures=[by_view]),
    ]
    overlays = [
        StoryFigure(
            f"Fig. 1, view {data.view_ids[view]}",
            "Crosses: where the calibration puts the points from the robot's pose alone. Dots: "
            "where they were measured.",
            _picture(plots.prediction_overlay(data, view, picture, calibration)),
        )
        for view, picture in _median_and_worst_pictures(data, summaries[0])
    ]
    if overlays:
        sections.append(Section("In the pictures", figures=overlays))
    write_story(path, title, verdict, sections)


def _median_and_worst_pictures(
    data: Dataset, summary: ErrorSummary
) -> list[tuple[int, UInt8[np.ndarray, "rows columns"]]]:
    """Return the views with the median and with the largest error, and their pictures."""
    if data.pictures is None:
        return []
    errors = summary.reprojection_errors.rms_per_view
    order = [int(view) for view in np.argsort(errors) if np.isfinite(errors[view])]
    chosen = [order[len(order) // 2], order[-1]] if len(order) > 1 else order
    return [(view, read_picture(data.pictures[view])) for view in chosen]


def _picture(figure: Figure) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return a figure as a picture in OpenCV's order of colours."""
    figure.set_dpi(DOTS_PER_INCH)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
