"""Write an HTML page on how well calibrations predict pictures that they were not fitted to."""

from collections.abc import Sequence
from pathlib import Path

from .. import plots
from ..calibration import Calibration
from ..dataset import Dataset
from .page import prediction_overlays
from .story import Section, StoryFigure, write_story
from .tables import ErrorSummary


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
        calibration: the first calibration, used for predictions in the pictures.
        data: the predicted views.
        summaries: errors of every calibration.
        rows: the table, with the names of the calibrations in the first row.
    """
    errors = {summary.name: summary.reprojection_errors for summary in summaries}
    histogram = StoryFigure(
        "Fig. 7.",
        "Distances between measured and predicted points.",
        plots.error_histogram(errors),
    )
    by_view = StoryFigure(
        "RMS of each view.",
        "A view that stands out has a wrong pose or a bad detection.",
        plots.view_errors(data, errors),
    )
    sections = [
        Section("Errors", header=rows[0], rows=rows[1:]),
        Section("Over all points", figures=[histogram]),
        Section("View by view", figures=[by_view]),
    ]
    overlays = [
        StoryFigure(f"Fig. 1, view {name}.", caption, overlay)
        for name, caption, overlay in prediction_overlays(data, summaries[0], calibration)
    ]
    if overlays:
        sections.append(Section("In the pictures", figures=overlays))
    write_story(path, title, verdict, sections)
