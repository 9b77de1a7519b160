"""Every encoding of a picture becomes a file with the same numbers."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from smartview_jax.recordings import picture_file

GREY = np.arange(6 * 8, dtype=np.uint8).reshape(6, 8)
COLOUR = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
DEEP = GREY.astype(np.uint16) * 1000


def message(pixels, encoding, padding=0):
    rows = np.frombuffer(pixels.tobytes(), np.uint8).reshape(len(pixels), -1)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    return SimpleNamespace(
        width=pixels.shape[1],
        height=pixels.shape[0],
        encoding=encoding,
        is_bigendian=int(pixels.dtype.byteorder == ">"),
        step=data.shape[1],
        data=data.ravel(),
    )


def read(pixels, encoding, padding=0):
    file = picture_file(message(pixels, encoding, padding))
    shown = cv2.imdecode(np.frombuffer(file.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert file.size == (8, 6)
    assert file.bits == 8 * shown.itemsize
    return shown


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("mono16", DEEP, DEEP),
        ("16UC1", DEEP.astype(">u2"), DEEP),
        ("bgr8", COLOUR, COLOUR),
        ("rgb8", COLOUR, COLOUR[..., ::-1]),
        ("rgba8", np.dstack([COLOUR, GREY]), COLOUR[..., ::-1]),
        ("bgra8", np.dstack([COLOUR, GREY]), COLOUR),
        ("rgb16", COLOUR.astype(np.uint16) * 257, COLOUR[..., ::-1].astype(np.uint16) * 257),
    ],
)
def test_numbers_are_kept(encoding, pixels, expected, padding):
    np.testing.assert_array_equal(read(pixels, encoding, padding), expected)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_gives_its_colours(pattern, bits):
    """A picture of one colour, as a sensor with filters sees it."""
    scale = 1 if bits == 8 else 257
    colour = {"r": 200 * scale, "g": 120 * scale, "b": 40 * scale}
    cell = np.array([colour[letter] for letter in pattern]).reshape(2, 2)
    pixels = np.tile(cell, (3, 4)).astype(np.uint8 if bits == 8 else np.uint16)
    shown = read(pixels, f"bayer_{pattern}{bits}")
    assert (shown == [colour["b"], colour["g"], colour["r"]]).all()


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_brightness_and_colour_in_turns(encoding):
    grey, neutral = np.full((6, 8), 126, np.uint8), np.full((6, 8), 128, np.uint8)
    parts = (neutral, grey) if encoding == "yuv422" else (grey, neutral)
    shown = read(np.dstack(parts), encoding)
    assert np.ptp(shown) == 0
    # 16 to 235 is the range of brightness in a video signal.
    assert abs(int(shown[0, 0, 0]) - 255 * (126 - 16) / 219) <= 1


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_compressed_pictures_stay_as_they_are(suffix):
    content = cv2.imencode(suffix, COLOUR)[1]
    file = picture_file(SimpleNamespace(format="bgr8; compressed", data=content))
    assert (file.content, file.suffix, file.size) == (content.tobytes(), suffix, (8, 6))
    with pytest.raises(ValueError, match="a damaged picture"):
        picture_file(SimpleNamespace(format="png", data=content[:20]))
