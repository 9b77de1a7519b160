"""Files that are no whole picture are named before anything is looked for in them."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from drawn_boards import chessboard_print, seen_in_perspective

from smartview_jax.detection import decode_picture, detect, picture_bytes, read_picture
from smartview_jax.targets import Chessboard


@pytest.fixture(scope="module")
def picture():
    return seen_in_perspective(*chessboard_print(6, 9, 1.0, ground=128))[0]


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_a_deep_picture_is_stretched(tmp_path, picture, bits):
    """Like a thermal camera: a small part of 16 bits, one dead pixel and one hot one."""
    deep = (7000 + (picture.astype(np.uint16) << 8 >> (16 - bits))).astype(np.uint16)
    deep[0, 0], deep[5, 5] = 0, 65535
    path = tmp_path / "deep.png"
    cv2.imwrite(str(path), deep)
    detection = detect(read_picture(path), Chessboard(6, 9, 0.03))
    expected = detect(picture, Chessboard(6, 9, 0.03))
    np.testing.assert_allclose(detection.pixels, expected.pixels, atol=0.1)
    read = decode_picture(path, picture_bytes(path))
    assert read.grey_range[0] >= 7000
    assert "of 65535" in read.range_in_words


def test_eight_bits_stay_as_they_are(tmp_path, picture):
    path = tmp_path / "dark.png"
    cv2.imwrite(str(path), picture // 8)
    np.testing.assert_array_equal(read_picture(path), picture // 8)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("left", [0.0, 0.01, 0.5, 0.98])
def test_a_file_that_was_cut_is_named(tmp_path, picture, suffix, left):
    whole = cv2.imencode(suffix, picture)[1].tobytes()
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole[: int(left * len(whole))])
    with pytest.raises(ValueError, match=r"a damaged picture|not a picture that can be read"):
        read_picture(path)


@pytest.mark.parametrize("progressive", [0, 1])
def test_damage_within_a_jpeg_is_named(tmp_path, picture, progressive, capfd):
    """A file that was cut and closed, and blocks that were overwritten: OpenCV shows the rest."""
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    whole = cv2.imencode(".jpg", picture, flags)[1].tobytes()
    middle = len(whole) // 2
    overwritten = whole[:middle] + bytes(300) + whole[middle + 300 :]
    # A progressive file has its blocks in several passes, and may be whole without a part of one.
    for damaged in (whole[:middle] + b"\xff\xd9", *([] if progressive else [overwritten])):
        (tmp_path / "damaged.jpg").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"damaged\.jpg: a damaged picture: Corrupt JPEG"):
            read_picture(tmp_path / "damaged.jpg")
    assert not capfd.readouterr().err


@pytest.mark.parametrize("colours", [1, 3])
def test_a_progressive_jpeg_has_all_its_scans(tmp_path, picture, colours):
    """Each beginning of such a file is a picture, coarser than the whole one."""
    shown = picture if colours == 1 else np.repeat(picture[..., None], 3, axis=2)
    whole = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    path = tmp_path / "progressive.jpg"
    path.write_bytes(whole)
    assert read_picture(path).shape == picture.shape
    scans = [k for k in range(len(whole)) if whole.startswith(b"\xff\xda", k)]
    assert len(scans) > 3
    for k in scans[1:]:
        # Up to the tables of the next scan.
        path.write_bytes(whole[: whole.rfind(b"\xff\xc4", 0, k)] + b"\xff\xd9")
        with pytest.raises(ValueError, match=r"progressive\.jpg: a damaged picture: its last"):
            read_picture(path)


def test_damage_within_a_png_is_named(tmp_path, picture):
    data = bytearray(cv2.imencode(".png", picture)[1].tobytes())
    data[len(data) // 2] ^= 16
    (tmp_path / "damaged.png").write_bytes(data)
    with pytest.raises(ValueError, match="the checksum of its chunk IDAT is wrong"):
        read_picture(tmp_path / "damaged.png")


def png(data, header, pixels):
    """A PNG with another header and other pixels, and with checksums that are right."""
    packed = zlib.compress(pixels)
    chunks = (b"IHDR" + header, b"IDAT" + packed[:50], b"IDAT" + packed[50:], b"IEND")
    lengths = (struct.pack(">I", len(body) - 4) for body in chunks)
    checksums = (struct.pack(">I", zlib.crc32(body)) for body in chunks)
    return data[:8] + b"".join(map(b"".join, zip(lengths, chunks, checksums, strict=True)))


def test_a_png_has_the_pixels_of_its_header(tmp_path, picture):
    data = cv2.imencode(".png", picture)[1].tobytes()
    height, width = picture.shape
    rows = b"".join(b"\0" + row.tobytes() for row in picture)
    path = tmp_path / "other.png"

    def read(height, width, pixels=rows):
        path.write_bytes(png(data, struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0), pixels))
        return read_picture(path)

    np.testing.assert_array_equal(read(height, width), picture)
    # A few bytes too many are no harm.
    np.testing.assert_array_equal(read(height, width, rows + bytes(9)), picture)
    with pytest.raises(ValueError, match=r"other\.png: .*more pixels than the \d+ x 24 of"):
        read(24, width)
    # Read, it would take a gigabyte before libpng sees the end.
    with pytest.raises(ValueError, match=r"fewer pixels than the 30000 x 30000"):
        read(30_000, 30_000)
    with pytest.raises(ValueError, match=r"fewer pixels"):
        read(height, width, rows[: len(rows) // 2])
    with pytest.raises(ValueError, match=r"more pixels"):
        read(height, width, bytes(300_000_000))


def test_an_interlaced_png_has_its_pixels_in_seven_passes(tmp_path, picture):
    data = cv2.imencode(".png", picture)[1].tobytes()
    height, width = 21, 13
    small = picture[:height, :width]
    passes = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2))
    pixels = b"".join(
        b"\0" + row.tobytes()
        for left, top, across, down in (*passes, (0, 1, 1, 2))
        for row in small[top::down, left::across]
    )
    path = tmp_path / "interlaced.png"
    path.write_bytes(png(data, struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 1), pixels))
    np.testing.assert_array_equal(read_picture(path), small)


def test_a_jpeg_with_a_thumbnail_or_a_tail_is_whole(tmp_path, picture):
    whole = cv2.imencode(".jpg", picture)[1].tobytes()
    thumbnail = b"Exif\x00\x00" + cv2.imencode(".jpg", picture[::16, ::16])[1].tobytes()
    segment = b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail
    (tmp_path / "camera.jpg").write_bytes(whole[:2] + segment + whole[2:] + b"maker's notes")
    assert read_picture(tmp_path / "camera.jpg").shape == picture.shape
    (tmp_path / "cut.jpg").write_bytes(whole[:2] + segment + whole[2 : len(whole) // 2])
    with pytest.raises(ValueError, match="its end mark is missing"):
        read_picture(tmp_path / "cut.jpg")


def test_several_pages_are_not_one_picture(tmp_path, picture):
    path = tmp_path / "stack.tif"
    cv2.imwritemulti(str(path), [picture, picture[::-1], picture])
    with pytest.raises(ValueError, match=r"stack\.tif: .*3 pages"):
        read_picture(path)
    cv2.imwritemulti(str(path), [picture])
    np.testing.assert_array_equal(read_picture(path), picture)


def test_a_huge_file_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "video.png"
    with open(path, "wb") as file:
        file.truncate(3_000_000_000)
    monkeypatch.setattr(type(path), "read_bytes", lambda _: pytest.fail("it was read"))
    with pytest.raises(ValueError, match=r"video\.png: 3 GB; a picture has at most 0\.5 GB"):
        read_picture(path)


def test_values_that_are_no_numbers_are_named(tmp_path):
    grey = np.full((40, 50), 0.5, dtype=np.float32)
    grey[3, 4] = np.nan
    cv2.imwrite(str(tmp_path / "float.tif"), grey)
    with pytest.raises(ValueError, match="1 pixels are not finite"):
        read_picture(tmp_path / "float.tif")


def test_a_picture_that_was_turned_is_told_from_one_of_another_size(tmp_path, picture):
    rows, columns = picture.shape
    path = tmp_path / "turned.png"
    cv2.imwrite(str(path), np.rot90(picture))
    with pytest.raises(ValueError, match="turned by 90 degrees"):
        read_picture(path, (columns, rows))
    with pytest.raises(ValueError, match=f"found {rows} x {columns}$"):
        read_picture(path, (columns + 1, rows))
