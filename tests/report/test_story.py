import base64
import re

import cv2
import numpy as np

from smartview_jax.report import Section, StoryFigure, write_story


def test_a_page_contains_its_pictures_and_escapes_its_texts(tmp_path):
    picture = np.zeros((20, 30), np.uint8)
    picture[5:10] = 200
    section = Section(
        "Found <it>",
        "in two views",
        [StoryFigure("(a)", "an edge & more", picture)],
        ("what", "value"),
        [("error", "0.1 mm")],
    )
    write_story(tmp_path / "page.html", "A run", "It is in the hand.", [section])
    page = (tmp_path / "page.html").read_text()
    assert "Found &lt;it&gt;" in page
    assert "an edge &amp; more" in page
    assert "<td>0.1 mm</td>" in page
    assert "It is in the hand." in page
    (data,) = re.findall(r"data:image/jpeg;base64,([^\"]+)", page)
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), 0)
    assert decoded.shape == (20, 30)
    assert decoded[7, 15] > 150
    # One file: nothing is fetched from elsewhere.
    assert "http" not in page
