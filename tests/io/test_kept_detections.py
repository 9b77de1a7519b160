"""Detections are repeated only where something has changed, and wrong paths are known at once."""

import shutil

import cv2
import numpy as np
import pytest
from detected_sample import copied_views
from text_files import edit

from smartview_jax.io import import_correspondences, load_dataset, save_dataset


@pytest.fixture(scope="module")
def detected(tmp_path_factory):
    """Three views of the sample with their detections; the last one shows no target."""
    folder = copied_views(tmp_path_factory.mktemp("detected") / "data", 3)
    cv2.imwrite(str(folder / "images/2.png"), np.full((480, 640), 90, dtype=np.uint8))
    load_dataset(folder)
    return folder


@pytest.fixture
def folder(detected, tmp_path):
    return shutil.copytree(detected, tmp_path / "data")


def looked_at(folder, **options):
    """The data set, and the views in which the target was looked for."""
    messages = []
    data = load_dataset(folder, progress=messages.append, **options)
    return data, [text.split()[5] for text in messages if text.startswith("looking for")]


def test_another_size_of_the_board_needs_no_other_detections(folder):
    before, _ = looked_at(folder)
    edit(folder / "dataset.yaml", "spacing: 0.0254", "spacing: 0.0248, radius: 0.006")
    data, looked = looked_at(folder)
    assert looked == []
    np.testing.assert_array_equal(data.pixels, before.pixels)
    assert data.points[0, 1, 0] == pytest.approx(0.0248)
    # The reason why nothing was found is kept too.
    assert data.masked_views == before.masked_views
    assert "0 blobs seen" in data.masked_views[0][1]
    assert "grey values are 90 to 90 of 255" in data.masked_views[0][1]


def test_only_what_changed_is_looked_at(folder):
    shutil.copy(folder / "images/0.png", folder / "images/2.png")
    assert looked_at(folder)[1] == ["2"]
    (folder / "images/1.png").unlink()
    edit(folder / "poses.csv", "\n1,", "\n#1,")
    data, looked = looked_at(folder)
    assert (data.view_ids, looked) == (("0", "2"), [])


@pytest.mark.parametrize("lost", [1, 120, 5_000])
def test_a_file_that_was_cut_costs_the_views_that_it_lost(folder, lost):
    whole, _ = looked_at(folder)
    text = (folder / "detections.csv").read_text()
    (folder / "detections.csv").write_text(text[: len(text) - lost].rsplit("\n", 1)[0] + "\n")
    again, looked = looked_at(folder)
    assert "0" not in looked
    assert "2" in looked
    np.testing.assert_array_equal(again.pixels, whole.pixels)
    assert again.masked_views == whole.masked_views


def test_another_pattern_is_looked_for(folder):
    edit(folder / "dataset.yaml", "origin_mark: true", "origin_mark: false")
    assert looked_at(folder)[1] == ["0", "1", "2"]
    edit(folder / "dataset.yaml", "rows: 10", "rows: 9")
    with pytest.raises(ValueError, match=r"found in none of 3 views \(.*is larger than 9 x 10"):
        load_dataset(folder)


@pytest.mark.parametrize("bad_views", ["raise", "mask"])
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("{view}.png", "{view}.jpg", r"0\.jpg: no such picture, nor any other of 3; .* 3 others"),
        ("images/{view}", "pictures/{view}", r"there is no folder .*pictures"),
        ("[640, 480]", "[480, 640]", r"0\.png: expected 480 x 640 px, found 640 x 480"),
    ],
)
def test_a_wrong_description_is_known_at_the_first_picture(folder, bad_views, old, new, message):
    edit(folder / "dataset.yaml", old, new)
    messages = []
    with pytest.raises((FileNotFoundError, ValueError), match=message) as caught:
        load_dataset(folder, bad_views=bad_views, progress=messages.append)
    assert "is it a" not in str(caught.value)
    assert messages == []


def test_zeros_that_a_spreadsheet_removed_from_pictures_names_are_named(folder):
    for picture in (folder / "images").iterdir():
        picture.rename(picture.with_name(f"0{picture.name}"))
    with pytest.raises(ValueError, match=r"remove leading zeros from the names, such as 00"):
        load_dataset(folder)


def test_one_picture_of_another_size_is_its_own_fault(folder):
    cv2.imwrite(str(folder / "images/0.png"), np.zeros((48, 64), dtype=np.uint8))
    data = load_dataset(folder, bad_views="mask")
    assert dict(data.masked_views)["0"].endswith("expected 640 x 480 px, found 64 x 48")
    assert np.asarray(data.visible)[1].all()


def test_imported_detections_are_tested(folder, tmp_path):
    data, _ = looked_at(folder)
    pixels = np.array(data.pixels)
    # A wrong point in one view, and another numbering of the points in the other.
    pixels[0, 37] += 12.0
    pixels[1] = pixels[1].reshape(5, 20, 2).swapaxes(0, 1).reshape(-1, 2)
    data = data.__class__.from_arrays(
        data.points, pixels, data.base_from_tool, data.image_size, target=data.target
    )
    save_dataset(data, tmp_path / "saved")
    saved = load_dataset(tmp_path / "saved")
    assert np.flatnonzero(~np.asarray(saved.visible)[0]).tolist() == [37]
    assert saved.notes[0].endswith("other points: 1 (views 0)")
    assert "the points found do not match this target" in dict(saved.masked_views)["1"]


def test_imported_pairs_are_tested(folder, tmp_path):
    data, _ = looked_at(folder)
    pixels = np.array(data.pixels)[:2]
    pixels[1] = pixels[1][np.random.default_rng(0).permutation(100)]
    names = ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
    pose = ",".join(map(str, np.eye(4).ravel()))
    (tmp_path / "poses.csv").write_text(f"view,{names}\n0,{pose}\n1,{pose}\n")
    rows = [
        ",".join(map(str, [view, *point, *pixel]))
        for view in (0, 1)
        for point, pixel in zip(np.asarray(data.points)[0], pixels[view], strict=True)
    ]
    (tmp_path / "corners.csv").write_text("\n".join(["view,X,Y,Z,u,v", *rows]) + "\n")
    pairs = import_correspondences(tmp_path / "poses.csv", tmp_path / "corners.csv", (640, 480))
    assert np.asarray(pairs.visible)[0].all()
    assert "the points found do not match this target" in dict(pairs.masked_views)["1"]
