"""Put plots, pictures and tables into an HTML page, so that it needs no other file."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import jinja2
import numpy as np
from jaxtyping import UInt8

from ..files import write_atomically
from ..geometry import TransformForm
from ..plots import PlotFigure

# Text is escaped, since names of views and folders come from the user's files.
get_template = jinja2.Environment(
    loader=jinja2.PackageLoader("smartview_jax.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
).get_template

CSS_PX_PER_INCH = 96
"""Number of CSS pixels in an inch: plots and their fonts are shown at their true size."""

COLUMN_INCHES = 5.0
"""Width above which a plot needs the whole page instead of one of two columns."""


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
    """A part of the page."""

    title: str
    text: str = ""
    figures: Sequence[StoryFigure] = ()
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def remarks_sections(warnings: Sequence[str], notes: Sequence[str]) -> list[Section]:
    """Return the section of the reasons to doubt a result, then notes; none without either."""
    rows = [(f"warning: {text}",) for text in warnings] + [(text,) for text in notes]
    return [Section("Warnings and notes", rows=rows)] if rows else []


def write_story(
    path: Path,
    title: str,
    verdict: str,
    sections: Sequence[Section],
    hand_eye_forms: Sequence[tuple[str, Sequence[TransformForm]]] = (),
) -> None:
    """Write a page that contains its pictures, completely or not at all.

    Args:
        verdict: the result in a sentence.
        hand_eye_forms: the hand-eye transform in the forms of other programs, to copy
            (`joint.hand_eye_forms`).
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
    page = get_template("story.html").render(
        title=title, verdict=verdict, sections=shown, hand_eye_forms=hand_eye_forms
    )
    write_atomically(path, page)


class PageFigure(NamedTuple):
    """A figure of a page as its template shows it.

    Attributes:
        name: printed first.
        url: the picture itself, as a data URL.
        style: size in CSS; empty for a picture that fills its column.
        wide: whether it takes the whole width of the page.
    """

    name: str
    text: str
    url: str
    style: str = ""
    wide: bool = False


def page_figure(
    name: str, text: str, image: PlotFigure | UInt8[np.ndarray, "rows columns *channels"]
) -> PageFigure:
    """Return a figure of a page from a plot, or from a picture that is grey or blue, green, red."""
    if isinstance(image, PlotFigure):
        inches = image.get_figwidth()
        style = f"width:{inches * CSS_PX_PER_INCH:.0f}px"
        wide = inches > COLUMN_INCHES
        return PageFigure(name, text, _data_url("png", image.png()), style, wide)
    # Noisy pictures are several times smaller as JPEG, and nothing is measured in them here.
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])
    return PageFigure(name, text, _data_url("jpeg", data.tobytes()))


def _data_url(kind: str, data: bytes) -> str:
    """Return the contents of a picture file as a data URL."""
    return f"data:image/{kind};base64," + base64.b64encode(data).decode("ascii")
