"""Write the story of a run as one HTML page of pictures and tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from ..files import write_atomically
from ..plots import PlotFigure
from .page import get_template
from .page_figures import page_figure


class StoryFigure(NamedTuple):
    """A picture with its caption.

    Attributes:
        name: printed first, such as "(a)".
        text: what it shows.
        picture: a plot, or a picture: grey, or in OpenCV's colour order: blue, green, red.
    """

    name: str
    text: str
    picture: PlotFigure | UInt8[np.ndarray, "rows columns *channels"]


class Section(NamedTuple):
    """A part of the page.

    Attributes:
        title: its heading.
        text: a paragraph; may be empty.
        figures: pictures side by side.
        header: names of the columns of the table; empty for a table without names.
        rows: of the table.
    """

    title: str
    text: str = ""
    figures: Sequence[StoryFigure] = ()
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def write_story(path: Path, title: str, verdict: str, sections: Sequence[Section]) -> None:
    """Write a page that contains its pictures, completely or not at all.

    Args:
        path: of the HTML file.
        title: of the page.
        verdict: the result in a sentence.
        sections: in their order.
    """
    shown = [
        {
            "title": section.title,
            "text": section.text,
            "figures": [page_figure(*figure) for figure in section.figures],
            "header": section.header,
            "rows": section.rows,
        }
        for section in sections
    ]
    page = get_template("story.html").render(title=title, verdict=verdict, sections=shown)
    write_atomically(path, page)
