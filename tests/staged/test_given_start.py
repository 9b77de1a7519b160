"""A known camera of pictures of another size is refused, with what may have changed the size."""

import pytest

from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.staged import require_picture_size


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((640, 480), "binned by 2 or scaled by 0.5"),
        ((427, 320), "scaled by 0.334"),
        ((1600, 1200), "were they scaled by 1.25"),
        ((960, 1280), "turned by 90 degrees"),
        ((1280, 800), "cut out"),
    ],
)
def test_pictures_of_another_size_are_refused(size, words):
    camera = Camera(900.0, 900.0, 640.0, 480.0, lens=Pinhole(), image_size=(1280, 960))
    require_picture_size("the camera", camera, (1280, 960))
    with pytest.raises(ValueError, match="1280 x 960") as refused:
        require_picture_size("the camera", camera, size)
    assert words in str(refused.value)
    assert ("binned" in str(refused.value)) == (size[0] < 640 or "binned" in words)
