import cv2
import numpy as np
import pytest
from detected_sample import detected_sample
from shared_data import shared_data

from smartview_jax.detection import (
    charuco_board,
    consistent_ordering,
    detect,
    dictionary_by_name,
    read_picture,
)
from smartview_jax.targets import Charuco, Chessboard, CircleGrid, TagGrid

SETS = {
    "visp_franka_eih": (Chessboard(6, 9, 0.0236), "franka_image-{1}.png", "", 432),
    "visp_franka_eth": (TagGrid(1, 1, 0.048, first_id=10), "franka_image-{1}.png", "", 32),
    "koide_charuco": (Charuco(5, 7, 0.024, 0.018), "images/20231006_{0:03d}.png", "20231006_", 155),
    "koide_charuco, legacy": (
        Charuco(7, 10, 0.024, 0.018, legacy=True),
        "images/20230920_{0:03d}.png",
        "20230920_",
        320,
    ),
}


@pytest.mark.parametrize("name", SETS)
def test_real_pictures_give_the_known_points(name):
    """Every view is found, and every point lies where the reference detection has one."""
    target, pattern, prefix, count = SETS[name]
    folder = shared_data(name.split(",")[0])
    corners = np.genfromtxt(folder / f"{prefix}corners.csv", delimiter=",", skip_header=1)
    views = np.unique(corners[:, 0]).astype(int)
    total = 0
    for view in views:
        detection = detect(read_picture(folder / pattern.format(view, view + 1)), target)
        assert detection.reason is None
        known = corners[corners[:, 0] == view, 4:6]
        seen = detection.pixels[detection.visible]
        nearest = np.linalg.norm(seen[:, None] - known[None], axis=-1).min(axis=1)
        assert np.sqrt(np.mean(nearest**2)) < 0.05
        total += detection.visible.sum()
    assert total == count


def test_the_samples_circles_are_the_known_points_in_their_order():
    """The grid's mark comes first; the reference counts from the other end."""
    folder, sample = shared_data("rct_circle10x10"), detected_sample()
    corners = np.genfromtxt(folder / "corners.csv", delimiter=",", skip_header=1)
    assert np.asarray(sample.visible).all()
    for view, actual in enumerate(np.asarray(sample.pixels)):
        known = corners[corners[:, 0] == view, 4:6][::-1]
        assert np.sqrt(np.mean(np.sum((actual - known) ** 2, axis=1))) < 0.05


@pytest.mark.parametrize(("name", "view"), [("tampere_kuka_2", 3), ("lwr4_joint", 10)])
def test_large_chessboards_are_found(name, view):
    target = Chessboard(17, 24, 0.015) if name == "tampere_kuka_2" else Chessboard(6, 9, 0.025)
    folder = shared_data(name)
    detection = detect(read_picture(folder / f"images/{view:03d}.png"), target)
    corners = np.genfromtxt(folder / "corners.csv", delimiter=",", skip_header=1)
    known = corners[corners[:, 0] == view, 4:6]
    # OpenCV 5 finds them up to 0.025 px from where OpenCV 4 does.
    np.testing.assert_allclose(detection.pixels, known, atol=0.05)


def drawn_circles(target, pitch=30, radius=9):
    """A drawing of a grid, and where its circles are; 16 times finer than its pixels."""
    centres = 60.0 + target.points[:, :2] / target.spacing * pitch
    size = tuple(int(x) for x in centres.max(axis=0) + 60)
    image = np.full(size[::-1], 0 if target.light_on_dark else 255, dtype=np.uint8)
    for x, y in centres:
        place = (round(16 * x), round(16 * y))
        colour = 255 if target.light_on_dark else 0
        cv2.circle(image, place, 16 * radius, colour, -1, cv2.LINE_AA, shift=4)
    return cv2.GaussianBlur(image, (0, 0), 0.8), centres


@pytest.mark.parametrize(
    "target",
    [
        CircleGrid(5, 7, 0.02),
        CircleGrid(5, 7, 0.02, light_on_dark=True),
        CircleGrid(9, 4, 0.01, asymmetric=True),
        CircleGrid(9, 4, 0.01, asymmetric=True, light_on_dark=True),
    ],
    ids=repr,
)
def test_drawn_circles_are_found_where_they_are(target):
    image, centres = drawn_circles(target)
    detection = detect(image, target)
    assert detection.reason is None
    best = min(np.abs(detection.pixels[order] - centres).max() for order in target.symmetries)
    assert best < 0.1


def test_a_chessboard_starts_at_a_light_square_however_it_is_turned():
    """Nine by six: half a turn swaps the colours, so each corner keeps its number."""
    target = Chessboard(6, 9, 0.02)
    dark = np.add.outer(np.arange(7), np.arange(10)) % 2 == 1
    squares = np.where(dark, 30, 230).astype(np.uint8)
    board = np.kron(squares, np.ones((30, 30), np.uint8))
    image = cv2.copyMakeBorder(board, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    upright, turned = detect(image, target), detect(np.ascontiguousarray(image[::-1, ::-1]), target)
    size = np.array(image.shape[::-1]) - 1.0
    np.testing.assert_allclose(upright.pixels, size - turned.pixels, atol=0.05)
    first = upright.pixels[[0, 1, 9, 10]].mean(axis=0).round().astype(int)
    assert image[first[1], first[0]] == 230


def test_drawn_tags_are_found_by_their_numbers_and_may_be_partly_hidden():
    target = TagGrid(2, 2, 0.04, 0.02, "DICT_4X4_50", first_id=7)
    image = np.full((400, 400), 255, dtype=np.uint8)
    for k, tag in enumerate(target.ids):
        drawing = cv2.aruco.generateImageMarker(dictionary_by_name(target.dictionary), tag, 120)
        y, x = 40 + 180 * (k // 2), 40 + 180 * (k % 2)
        image[y : y + 120, x : x + 120] = drawing
    whole = detect(image, target)
    assert whole.visible.all()
    np.testing.assert_allclose(whole.pixels[0], [39.5, 39.5], atol=1.0)
    # Order of the corners: top left, top right, bottom right, bottom left.
    assert (whole.pixels[1] - whole.pixels[0])[0] > 100
    image[:200] = 255
    part = detect(image, target)
    assert part.visible.tolist() == [False] * 8 + [True] * 8
    assert np.isnan(part.pixels[:8]).all()


@pytest.mark.parametrize("legacy", [False, True])
def test_drawn_charuco_boards_new_and_old(legacy):
    target = Charuco(6, 8, 0.03, 0.02, "DICT_5X5_100", legacy)
    image = charuco_board(target).generateImage((600, 800), marginSize=30)
    assert detect(image, target).visible.all()
    wrong = detect(image, Charuco(6, 8, 0.03, 0.02, "DICT_5X5_100", not legacy))
    assert wrong.visible.sum() < 35


def test_two_boards_alike_in_one_picture_are_told_so():
    """Markers that are seen twice contradict each other, so that no corner is found."""
    board = cv2.aruco.CharucoBoard(
        (5, 4), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    picture = np.full((480, 900), 255, np.uint8)
    picture[60:380, 30:430] = picture[80:400, 470:870] = board.generateImage((400, 320))
    target = Charuco(5, 4, 0.03, 0.022, "DICT_4X4_50")
    assert "two such boards" in str(detect(picture, target).reason)
    blurred = cv2.GaussianBlur(picture[:, :450], (0, 0), 8.0)
    assert "two such boards" not in str(detect(blurred, target).reason)
    # The board has the markers 0 to 9; of others there may be any number.
    other = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 15, 120
    )
    picture[:] = 255
    picture[60:180, 30:150] = picture[60:180, 470:590] = other
    assert "two such boards" not in str(detect(picture, target).reason)


def test_what_is_not_there_is_said():
    blank = np.full((200, 300), 255, dtype=np.uint8)
    assert "0 blobs seen, 35 expected" in detect(blank, CircleGrid(5, 7, 0.02)).reason
    assert "no chessboard with 6 x 9" in detect(blank, Chessboard(6, 9, 0.1)).reason
    assert "0 markers" in detect(blank, Charuco(5, 7, 0.024, 0.018)).reason
    assert "no tag 3 to 3" in detect(blank, TagGrid(1, 1, 0.1, first_id=3)).reason
    with pytest.raises(ValueError, match="expected uint8"):
        detect(blank.astype(float), Chessboard(6, 9, 0.1))


def test_pictures_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png: no such picture"):
        read_picture(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("not a picture")
    with pytest.raises(ValueError, match=r"text\.png: not a picture that can be read"):
        read_picture(tmp_path / "text.png")
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((10, 20), dtype=np.uint8))
    with pytest.raises(ValueError, match="expected 640 x 480 px, found 20 x 10"):
        read_picture(tmp_path / "small.png", (640, 480))


def test_views_that_do_not_turn_the_camera_keep_their_order():
    """Nothing can be learnt from them, and nothing fails."""
    target = CircleGrid(5, 7, 0.02)
    _, centres = drawn_circles(target)
    chosen = consistent_ordering(
        np.stack([centres, centres + 1.0, centres + 2.0]),
        np.ones((3, 35), dtype=bool),
        target,
        np.stack([np.eye(3)] * 3),
        (400, 300),
    )
    assert chosen.symmetry.tolist() == [0, 0, 0]
    assert "the robot's rotations do not determine the right one" in chosen.message


@pytest.mark.parametrize("hidden", [0, 30])
def test_robot_motion_orders_a_symmetric_grid(hidden):
    """The sample's views turned by random symmetries come back to one order, also seen in part."""
    rng = np.random.default_rng(1)
    data = detected_sample()
    plain = CircleGrid(10, 10, 0.0254)
    turns = rng.integers(0, 4, data.view_count)
    whole = np.array(data.pixels)
    for view in whole[::2]:
        view[rng.choice(100, hidden, replace=False)] = np.nan
    turned = np.stack([p[plain.symmetries[k]] for p, k in zip(whole, turns, strict=True)])
    chosen = consistent_ordering(
        turned,
        np.isfinite(turned).all(axis=2),
        plain,
        np.asarray(data.base_from_tool.inverse().rotation().as_matrix()),
        data.image_size,
    )
    back = [p[plain.symmetries[k]] for p, k in zip(turned, chosen.symmetry, strict=True)]
    # The sample's own mark has x along the base's x: the way round that is turned least.
    np.testing.assert_array_equal(back, whole)


def test_a_picture_is_read_as_the_sensor_saw_it(tmp_path):
    """A camera's pixels are its sensor's: an orientation noted in one file would turn them."""
    picture = np.zeros((48, 64), dtype=np.uint8)
    picture[:10, :10] = 255
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    # EXIF with the one entry "orientation" (0x0112): 6, a quarter turn.
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
    exif = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01" + entry + bytes(4)
    marked = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    (tmp_path / "turned.jpg").write_bytes(marked)
    read = read_picture(tmp_path / "turned.jpg", (64, 48))
    assert read[5, 5] > 200
    assert read[5, 55] < 50
