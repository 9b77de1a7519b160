"""Put plots and pictures into a page, so that it needs no other file."""

import base64
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from ..plots import PlotFigure

CSS_PX_PER_INCH = 96
"""Number of CSS pixels in an inch: plots and their fonts are shown at their true size."""

COLUMN_INCHES = 5.0
"""Width above which a plot needs the whole page instead of one of two columns."""


class PageFigure(NamedTuple):
    """A figure of a page as its template shows it.

    Attributes:
        name: printed first.
        text: caption.
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
