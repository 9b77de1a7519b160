"""Blurred pictures are named, whether their target is found or not; sharp ones are not."""

import cv2
import numpy as np
import pytest
from detected_sample import copied_views, detected_sample

from smartview_jax.detection import Detection, empty_detection
from smartview_jax.io import load_dataset
from smartview_jax.io.blurred_views import blur_notes


def views(widths, noise=0.1):
    """Detections with edges so wide; a negative width is of a picture without the target."""
    found = Detection(np.zeros((4, 2)), np.ones(4, dtype=bool), None, noise)
    missed = empty_detection(4, "not found")
    return {
        str(view): (found if width > 0.0 else missed)._replace(edge_width=abs(width))
        for view, width in enumerate(widths)
    }


@pytest.mark.parametrize("widths", [[1.5] * 5, [1.2, 1.4, 2.0, 3.3, 4.5], [-9.0], []])
def test_sharp_pictures_get_no_remark(widths):
    assert blur_notes(views(widths)) == ()


def test_the_sharp_sample_gets_no_remark():
    assert not any("blur" in note for note in detected_sample().notes)


def test_pictures_that_are_all_blurred_are_told_so_once_with_their_noise():
    (note,) = blur_notes(views([6.0, 7.0, 8.0, -9.0], noise=0.4))
    assert "edges are 7 px wide" in note
    assert "its points scatter by 0.4 px" in note
    # Detections of earlier versions have no noise.
    assert "scatter" not in blur_notes(views([6.0, 7.0, 8.0], noise=0.0))[0]


def test_views_far_more_blurred_than_the_others_are_named():
    (note,) = blur_notes(views([1.5, 6.0, 1.4, 1.6, -12.0, 1.5]))
    assert note.startswith("views 1, 4: far more blurred")
    assert "up to 12 px wide there, and 1.5 px in the median view" in note


def test_a_blurred_picture_of_a_folder_is_named_also_when_its_detection_was_kept(tmp_path):
    folder = copied_views(tmp_path / "data")
    picture = folder / "images/2.png"
    cv2.imwrite(str(picture), cv2.GaussianBlur(cv2.imread(str(picture)), (0, 0), 8.0))
    said = []
    for _ in range(2):
        data = load_dataset(folder, progress=said.append)
        assert dict(data.masked_views).keys() == {"2"}
        (note,) = (text for text in data.notes if "blurred" in text)
        assert note.startswith("view 2: far more blurred than the others: edges are 1")
    assert "detections of 4 views from detections.csv" in said
