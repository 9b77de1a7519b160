import shutil

import numpy as np
import pytest
from jaxlie import SE3
from shared_data import shared_data

from smartview_jax.io import (
    import_correspondences,
    import_matrix_rows,
    read_matrix_rows,
    write_matrix_rows,
)
from smartview_jax.targets import Chessboard


def test_matrices_on_lines():
    folder = shared_data("tampere_kuka_2")
    table = np.genfromtxt(folder / "poses.csv", delimiter=",", skip_header=1)
    poses = read_matrix_rows(folder / "RobotPosesVec.txt", "m")
    np.testing.assert_allclose(poses.as_matrix(), table[:, 1:].reshape(-1, 4, 4), atol=1e-6)


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_what_is_written_is_read(tmp_path, unit):
    poses = read_matrix_rows(shared_data("tampere_kuka_2") / "RobotPosesVec.txt", "m")
    write_matrix_rows(tmp_path / "poses.txt", poses, unit)
    again = read_matrix_rows(tmp_path / "poses.txt", unit)
    np.testing.assert_allclose(again.as_matrix(), poses.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("separator", [" ", "\t", ";", "; ", ", "])
@pytest.mark.parametrize("comma", [".", ","])
def test_lines_are_written_as_several_countries_write_numbers(tmp_path, separator, comma):
    pose = np.eye(4)
    pose[:3, 3] = 0.5, -1.25, 2.0
    text = separator.join(f"{x:.2f}" for x in pose.ravel())
    if comma == "," and separator != ", ":
        text = text.replace(".", ",").replace("-", "\u2212")
    (tmp_path / "poses.txt").write_text(f"{text}\n" * 2, encoding="utf-16")
    said = []
    read = read_matrix_rows(tmp_path / "poses.txt", "m", said.append)
    np.testing.assert_allclose(read.as_matrix(), [pose, pose], atol=1e-15)
    assert said[0].startswith("poses.txt was read in the encoding UTF-16")
    assert ("with a decimal comma" in said[0]) == ("\u2212" in text)


def test_what_could_not_be_read_is_not_written(tmp_path):
    far = SE3.from_translation(np.array([[0.0, 0.0, 200.0]]))
    with pytest.raises(ValueError, match="millimetres or inches given as metres"):
        write_matrix_rows(tmp_path / "poses.txt", far, "m")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def folder(tmp_path):
    """Two views of a real set, as its authors keep them."""
    original = shared_data("tampere_kuka_2")
    lines = (original / "RobotPosesVec.txt").read_text().splitlines()
    (tmp_path / "poses.txt").write_text("\n".join(lines[:2]) + "\n")
    (tmp_path / "images").mkdir()
    for view in range(2):
        shutil.copy(original / f"images/{view:03d}.png", tmp_path / "images")
    return tmp_path


def test_lines_and_numbered_pictures_are_a_data_set(folder):
    target = Chessboard(17, 24, 0.015)
    data = import_matrix_rows(folder / "poses.txt", "m", "images/{view:03d}.png", target)
    original = shared_data("tampere_kuka_2")
    known = import_correspondences(original / "poses.csv", original / "corners.csv", (1920, 1200))
    assert data.view_ids == ("0", "1")
    assert data.image_size == (1920, 1200)
    gap = np.asarray(data.pixels - known.pixels[:2])
    assert np.sqrt(np.mean(np.sum(gap**2, axis=-1))) < 0.05
    np.testing.assert_allclose(
        data.base_from_tool.as_matrix(), known.base_from_tool.as_matrix()[:2], atol=1e-6
    )


def test_pictures_and_lines_must_match(folder):
    target = Chessboard(17, 24, 0.015)
    shutil.copy(folder / "images/001.png", folder / "images/009.png")
    with pytest.raises(ValueError, match=r"poses\.txt: no pose for the picture 009\.png"):
        import_matrix_rows(folder / "poses.txt", "m", "images/{view:03d}.png", target)
    (folder / "images/009.png").unlink()
    (folder / "images/000.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"002\.png: no such picture"):
        import_matrix_rows(folder / "poses.txt", "m", "images/{view:03d}.png", target, first=1)
    with pytest.raises(ValueError, match=r"expected a name with \{view\}"):
        import_matrix_rows(folder / "poses.txt", "m", "images/0.png", target)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1 has 3 numbers, not 16"),
        ("a b\n", "line 1 is not a row of numbers"),
        ("# nothing\n", "no poses"),
        (" ".join(map(str, np.diag([1, 1, -1, 1]).ravel())), "row 1: .*mirrored"),
    ],
)
def test_wrong_lines_are_named(tmp_path, text, message):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(ValueError, match=rf"poses\.txt: .*{message}"):
        read_matrix_rows(tmp_path / "poses.txt", "m")
