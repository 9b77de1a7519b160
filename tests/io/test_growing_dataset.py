"""Views are added as pairs: a process that is killed leaves no row without its picture."""

import os

import numpy as np
import pytest

from smartview_jax.files import write_atomically
from smartview_jax.geometry import host_transforms
from smartview_jax.io import GrowingDataset, load_view_pictures, write_new_dataset

SIZE = (64, 48)


def pose(k):
    matrix = np.eye(4)
    matrix[:3, 3] = [0.5, 0.001 * k, 0.25]
    return matrix


def new_folder(path, robot="kuka"):
    write_new_dataset(path, robot, "chessboard", "eye_in_hand", SIZE)
    return path


def picture(k):
    return np.full(SIZE[::-1], 10 * k, np.uint8)


@pytest.mark.parametrize("robot", ["kuka", "ur", "matrix", "abb", "puma"])
def test_views_that_were_added_are_read(tmp_path, robot):
    folder = new_folder(tmp_path / "data", robot)
    with GrowingDataset(folder) as data:
        assert data.names == ()
        assert [data.add(picture(k), host_transforms(pose(k))) for k in (1, 2)] == ["v1", "v2"]
    # Another process goes on.
    with GrowingDataset(folder) as data:
        assert data.names == ("v1", "v2")
        assert data.add(picture(3), host_transforms(pose(3))) == "v3"
    views = load_view_pictures(folder)
    assert views.view_ids == ["v1", "v2", "v3"]
    np.testing.assert_allclose(views.base_from_tool, [pose(k) for k in (1, 2, 3)], atol=1e-9)
    assert sorted(p.name for p in (folder / "images").iterdir()) == ["v1.png", "v2.png", "v3.png"]


def test_what_could_not_be_read_back_is_refused_and_nothing_is_written(tmp_path):
    folder = new_folder(tmp_path / "data")
    with GrowingDataset(folder) as data:
        data.add(picture(1), host_transforms(pose(1)), "first")
        before = sorted(p.name for p in folder.rglob("*") if "pending" not in p.name)
        far = pose(1)
        far[0, 3] = 812.0
        for name, shape, where, words in (
            ("first", SIZE, pose(1), "exists already"),
            ("../out", SIZE, pose(1), "no name"),
            ("small", (32, 48), pose(1), r"image_size: \[32, 48\]"),
            ("far", SIZE, far, "millimetres or inches given as metres"),
        ):
            with pytest.raises(ValueError, match=words):
                data.add(np.zeros(shape[::-1], np.uint8), host_transforms(where), name)
    assert sorted(p.name for p in folder.rglob("*")) == before


def test_a_table_that_cannot_be_continued_is_named(tmp_path):
    folder = new_folder(tmp_path / "data")
    text = (folder / "dataset.yaml").read_text()
    write_atomically(
        folder / "dataset.yaml", text.replace("file: poses.csv", "rows: 3\n  file: poses.csv")
    )
    with pytest.raises(ValueError, match=r"poses\.rows: remove this entry"):
        GrowingDataset(folder)
    write_atomically(folder / "dataset.yaml", text)
    write_atomically(folder / "poses.csv", "view;x;y;z;A;B;C\n")
    with pytest.raises(ValueError, match="expected the header view,x,y,z,A,B,C"):
        GrowingDataset(folder)


class Killed(BaseException):
    """The end of a process, after which it changes nothing any more."""


def add_until_killed(folder, changes, monkeypatch):
    """Add a second view, and end before or after one of the changes that this makes."""
    data = GrowingDataset(folder)
    data.add(picture(1), host_transforms(pose(1)))
    left = [changes]
    with monkeypatch.context() as patch:
        for name in ("replace", "link", "unlink", "rename"):
            real = getattr(os, name)

            def call(*args, real=real, **kwargs):
                for work in (lambda: None, lambda: real(*args, **kwargs)):
                    left[0] -= 1
                    if left[0] < 0:
                        raise Killed
                    result = work()
                return result

            patch.setattr(os, name, call)
        try:
            data.add(picture(2), host_transforms(pose(2)))
        except Killed:
            return True
    return False


def test_a_row_never_stands_without_its_picture_nor_the_reverse(tmp_path, monkeypatch):
    """The process ends before and after every change that it makes in the folder."""
    counts, killed = [], True
    while killed:
        folder = new_folder(tmp_path / f"data{len(counts)}")
        killed = add_until_killed(folder, len(counts), monkeypatch)
        # As the killed process left it, and as the next one finds it.
        for _ in range(2):
            views = load_view_pictures(folder)
            assert all(path.read_bytes()[:4] == b"\x89PNG" for path in views.pictures)
            heights = [round(1e3 * p[1, 3]) for p in views.base_from_tool]
            assert heights == [1, 2][: len(views.view_ids)]
            with GrowingDataset(folder) as data:
                assert list(data.names) == views.view_ids
        seen = sorted(p.name for p in (folder / "images").iterdir())
        assert seen == [f"{view}.png" for view in views.view_ids]
        assert len(list(folder.iterdir())) == 3
        counts.append(len(views.view_ids))
    # Both sides of the one moment at which a view appears were met.
    assert set(counts) == {1, 2}
    assert counts == sorted(counts)
    assert len(counts) >= 8
