import dataclasses
import os
import shutil
import unicodedata

import cv2
import numpy as np
import pytest
from detected_sample import copied_views, detected_sample
from shared_data import shared_data
from text_files import edit

from smartview_jax.dataset import Dataset, Rig
from smartview_jax.io import import_correspondences, load_dataset, save_dataset, save_rig


@pytest.fixture
def folder(tmp_path):
    """A copy of the sample with four of its views."""
    return copied_views(tmp_path / "data")


def test_the_sample_is_whole():
    data = detected_sample()
    assert data.view_ids == tuple(map(str, range(15)))
    assert data.observation_count == 1500
    assert data.masked_views == ()


def test_the_sample_is_the_original():
    original = load_dataset(shared_data("rct_circle10x10"), keep_detections=False)
    sample = detected_sample()
    assert sample.view_ids == original.view_ids
    np.testing.assert_allclose(sample.pixels, original.pixels, atol=0.01)
    np.testing.assert_allclose(
        sample.base_from_tool.as_matrix(), original.base_from_tool.as_matrix(), atol=1e-12
    )


def test_pairing_is_by_name_not_by_position(folder):
    before = load_dataset(folder, keep_detections=False)
    lines = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").write_text("\n".join([lines[0], *lines[:0:-1]]) + "\n")
    after = load_dataset(folder, keep_detections=False)
    assert after.view_ids == before.view_ids[::-1]
    np.testing.assert_array_equal(after.pixels[0], before.pixels[3])


def test_detections_are_kept_and_made_anew_when_a_picture_changes(folder):
    first = load_dataset(folder)
    assert (folder / "detections.csv").is_file()
    messages = []
    second = load_dataset(folder, progress=messages.append)
    assert messages == ["detections of 4 views from detections.csv"]
    np.testing.assert_array_equal(first.pixels, second.pixels)
    shutil.copy(folder / "images/1.png", folder / "images/0.png")
    third = load_dataset(folder)
    np.testing.assert_array_equal(third.pixels[0], first.pixels[1])


def test_a_point_that_was_hidden_stays_hidden(folder, tmp_path):
    data = load_dataset(folder, keep_detections=False)
    visible = np.array(data.visible)
    visible[1, 7] = visible[2] = False
    save_dataset(data.with_visible(visible), tmp_path / "saved")
    again = load_dataset(tmp_path / "saved")
    np.testing.assert_array_equal(again.visible, visible)


def test_what_is_saved_is_loaded(folder, tmp_path):
    data = load_dataset(folder)
    save_dataset(data, tmp_path / "saved")
    again = load_dataset(tmp_path / "saved")
    np.testing.assert_array_equal(again.pixels, data.pixels)
    np.testing.assert_allclose(
        again.base_from_tool.as_matrix(), data.base_from_tool.as_matrix(), atol=1e-15
    )
    assert (again.view_ids, again.image_size, again.target) == (
        data.view_ids,
        data.image_size,
        data.target,
    )


def test_points_without_a_target_are_listed(folder, tmp_path):
    """Arrays of points, such as machined holes, need no pattern that the package knows."""
    data = load_dataset(folder)
    rng = np.random.default_rng(0)
    points = np.asarray(data.points)[0] + rng.normal(scale=1e-4, size=data.points.shape[1:])
    listed = Dataset.from_arrays(points, data.pixels, data.base_from_tool, data.image_size)
    save_dataset(listed, tmp_path / "saved")
    again = load_dataset(tmp_path / "saved")
    np.testing.assert_array_equal(again.points, listed.points)
    np.testing.assert_array_equal(again.pixels, listed.pixels)


def test_points_that_differ_between_views_are_not_written(folder, tmp_path):
    data = load_dataset(folder)
    points = np.array(data.points)
    points[2, 5, 0] += 1e-3
    moved = Dataset.from_arrays(points, data.pixels, data.base_from_tool, data.image_size)
    with pytest.raises(ValueError, match="its points differ between views 0 and 2"):
        save_dataset(moved, tmp_path / "saved")
    with pytest.raises(ValueError, match="has points that are not its target's"):
        save_dataset(dataclasses.replace(moved, target=data.target), tmp_path / "saved")
    assert list(tmp_path.glob("*saved*")) == []


def test_a_set_that_cannot_be_read_back_leaves_no_file(folder, tmp_path):
    """Its detections are written before the description is checked."""
    data = dataclasses.replace(load_dataset(folder), image_size=(10**9, 480))
    with pytest.raises(ValueError, match=r"saved/dataset\.yaml: not written, .*image_size"):
        save_dataset(data, tmp_path / "saved")
    assert list(tmp_path.glob("*saved*")) == []


def test_listed_points_are_not_looked_for_in_pictures(folder):
    listed = "target: {kind: points, coordinates: [[0.0, 0.0, 0.0]]} #"
    edit(folder / "dataset.yaml", "target: {", listed)
    with pytest.raises(ValueError, match="listed points are not detected in pictures"):
        load_dataset(folder)


def test_an_unknown_format_writes_nothing(folder, tmp_path):
    data = load_dataset(folder)
    for save, what in ((save_dataset, data), (save_rig, Rig({"left": data}))):
        with pytest.raises(ValueError, match="found 'kuka_abd'"):
            save(what, tmp_path / "saved", "kuka_abd")
        assert not (tmp_path / "saved").exists()


@pytest.mark.parametrize("pose_format", ["kuka_abc", "matrix"])
def test_the_robots_format_is_known(folder, tmp_path, pose_format):
    """In it the hand-eye transform is reported."""
    save_dataset(load_dataset(folder), tmp_path / "saved", pose_format)
    data = load_dataset(tmp_path / "saved")
    assert data.pose_format == pose_format
    assert data.without([data.view_ids[0]]).pose_format == pose_format


def test_a_view_without_detection_stays_an_empty_view(folder):
    cv2.imwrite(str(folder / "images/2.png"), np.full((480, 640), 255, dtype=np.uint8))
    data = load_dataset(folder)
    assert data.view_ids == ("0", "1", "2", "3")
    assert not np.asarray(data.visible)[2].any()
    assert np.asarray(data.visible)[3].all()
    ((view, reason),) = data.masked_views
    assert view == "2"
    assert "0 blobs seen, 100 expected" in reason


def test_a_missing_picture_is_an_error_or_a_masked_view(folder):
    """It is an error at once: nobody waits until all pictures before it are searched."""
    (folder / "images/1.png").unlink()
    said = []
    with pytest.raises(FileNotFoundError, match=r"1\.png: no such picture"):
        load_dataset(folder, progress=said.append)
    assert not [text for text in said if "looking for the target" in text]
    data = load_dataset(folder, bad_views="mask")
    assert data.masked_views[0][0] == "1"
    assert "no such picture" in data.masked_views[0][1]


def test_a_pose_that_is_none_is_an_error_or_a_masked_view(folder):
    edit(folder / "poses.csv", "\n1,0.5752203716195865", "\n1,nan")
    with pytest.raises(ValueError, match=r"poses\.csv: .*row 1 contains NaN"):
        load_dataset(folder)
    data = load_dataset(folder, bad_views="mask")
    assert data.view_ids == ("0", "1", "2", "3")
    assert data.masked_views == (("1", "quaternion_xyzw: row 1 contains NaN or infinity (x)"),)
    assert np.asarray(data.visible).any(axis=1).tolist() == [True, False, True, True]
    assert np.isfinite(data.base_from_tool.wxyz_xyz).all()


def test_a_picture_that_cannot_be_read_is_named(folder):
    (folder / "images/1.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"1\.png: not a picture"):
        load_dataset(folder)


def test_a_picture_without_a_pose_is_named(folder):
    shutil.copy(folder / "images/1.png", folder / "images/extra.png")
    with pytest.raises(ValueError, match=r"no pose for the picture extra\.png"):
        load_dataset(folder)


CASES = {
    "duplicate row": ("poses.csv", "\n1,", "\n0,", "view 0 has more than one row"),
    "not a number": ("poses.csv", "\n1,0", "\n1,x0", "view 1: x is 'x0"),
    "NaN": ("poses.csv", "\n1,0.5752203716195865", "\n1,nan", "row 1 contains NaN"),
    "no column": ("poses.csv", "qw", "w", "missing qw"),
    "unit": ("dataset.yaml", "length_unit: m", "length_unit: inch", "length_unit is one of m, cm"),
    "no unit": ("dataset.yaml", "  angle_unit: rad\n", "", "'poses.angle_unit' is missing"),
    "codec": ("dataset.yaml", "quaternion_xyzw", "euler", "poses.codec is one of matrix"),
    "not seen": ("detections.csv", "0,0,", "0,x,", "view 0: point is 'x', not a number"),
    "misspelt": ("dataset.yaml", "mount:", "moutn:", "'moutn'; did you mean 'mount'"),
    "key twice": ("dataset.yaml", "mount:", "mount: eye_to_hand\nmount:", "'mount' comes twice"),
    "huge grid": ("dataset.yaml", "rows: 10", "rows: 1000000000", "target.rows: expected .* 1000"),
    "far length": ("dataset.yaml", "0.0254", "1e6", "target.spacing: expected a length in m"),
    "millimetres": (
        "poses.csv",
        "\n1,0.575220",
        "\n1,575.220",
        "view 1: x is 575.2.* m, more than",
    ),
    "digits": ("poses.csv", "\n1,0.575220", "\n1,0_575220", "view 1: x is .*not a number"),
    "name twice": ("poses.csv", "view,x", "view,view,x", "column view comes twice"),
    "file name": (
        "dataset.yaml",
        "file: poses.csv",
        'file: "a\\0b"',
        "poses.file: expected a name",
    ),
    "braces": ("dataset.yaml", "{view}", "{view.__class__}", "pictures.pattern: expected a name"),
    "bytes": ("poses.csv", "qw", "\u00e4", "missing qw"),
    "direction": ("dataset.yaml", "base_from_tool", "flange", "poses.direction is one of"),
    "version": (
        "dataset.yaml",
        "smartview_dataset: 1",
        "smartview_dataset: 7",
        "expected 1, found 7",
    ),
    "mount": ("dataset.yaml", "eye_in_hand", "eye_of_god", "found 'eye_of_god'"),
    "target": ("dataset.yaml", "circle_grid", "cube", "target.kind is one of"),
    "size": ("dataset.yaml", "[640, 480]", "[640]", "camera.image_size: expected"),
    "other size": ("dataset.yaml", "[640, 480]", "[800, 600]", "expected 800 x 600 px, found 640"),
    "wrong grid": ("dataset.yaml", "rows: 10", "rows: 25", "found in none of 4 views"),
    "more rows": ("dataset.yaml", "rows: 10", "rows: 17", "is it a grid of 10 x 10?"),
    "more columns": ("dataset.yaml", "columns: 10", "columns: 11", "is it a grid of 10 x 10?"),
    "pattern": ("dataset.yaml", "{view}", "view", "expected a name with {view}"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_named_with_its_file(folder, case):
    name, old, new, message = CASES[case]
    if name == "detections.csv":
        save_dataset(load_dataset(folder), folder)
    edit(folder / name, old, new)
    if case == "bytes":
        (folder / name).write_bytes((folder / name).read_text().encode("latin-1"))
    with pytest.raises(ValueError, match=message.replace("{", r"\{").replace("[", r"\[")):
        load_dataset(folder)


@pytest.fixture(scope="module")
def saved_once(tmp_path_factory):
    """Two views as a folder of detections, without pictures."""
    folder = tmp_path_factory.mktemp("saved")
    data = load_dataset(copied_views(folder / "pictures", 2), keep_detections=False)
    save_dataset(data, folder / "saved")
    return folder / "saved"


@pytest.fixture
def saved(saved_once, tmp_path):
    return shutil.copytree(saved_once, tmp_path / "saved")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\n1,7,", "\n1,6,", "view 1: point 6 has more than one row"),
        ("\n1,7,", "\n1,nan,", "view 1: point is nan, not a finite number"),
        ("\n1,7,", "\n1,1e300,", "view 1: the target has no point 1e\\+300"),
        ("\n1,7,", "\n1,7,nan,0,\n1,7,", "view 1: u_px is nan, not a finite number"),
        ("\n1,7,", "\n,7,", "row 108 has an empty view"),
        ("\n1,7,", '\n1,"' + 200_000 * "7" + '",', "not readable as a table: field larger"),
    ],
)
def test_a_wrong_detection_is_named(saved, old, new, message):
    edit(saved / "dataset.yaml", "detections: {rows: 200}\n", "")
    edit(saved / "detections.csv", old, new)
    with pytest.raises(ValueError, match=rf"detections\.csv: .*{message}"):
        load_dataset(saved)


@pytest.mark.parametrize("name", ["detections.csv", "poses.csv", "dataset.yaml"])
def test_what_was_saved_and_then_cut_is_refused(saved, name):
    """A table that lacks rows is as good a table as any: the description says how many it has."""
    whole = (saved / name).read_text()
    for end in range(1, len(whole.rstrip()), 1 + len(whole) // 23):
        (saved / name).write_text(whole[:end])
        with pytest.raises(ValueError, match=r"(detections|poses)\.csv|dataset\.yaml"):
            load_dataset(saved)
    (saved / name).write_text(whole)
    load_dataset(saved)


def test_kept_detections_that_were_cut_are_made_anew(folder):
    first = load_dataset(folder)
    lines = (folder / "detections.csv").read_text().splitlines(keepends=True)
    (folder / "detections.csv").write_text("".join(lines[:150]))
    messages = []
    again = load_dataset(folder, progress=messages.append)
    assert messages[0].startswith("looking for the target")
    np.testing.assert_array_equal(again.pixels, first.pixels)


def test_an_interrupted_detection_leaves_no_file(folder, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        load_dataset(folder)
    assert not list(folder.glob("*detections*"))


def test_not_a_data_set(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"neither dataset\.yaml nor cal_data\.yaml"):
        load_dataset(tmp_path)


def test_pairs_with_a_view_that_has_no_pose(tmp_path):
    names = ",".join(f"m{i}{j}" for i in range(4) for j in range(4))
    (tmp_path / "p.csv").write_text(f"view,{names}\n0,{','.join(map(str, np.eye(4).ravel()))}\n")
    (tmp_path / "c.csv").write_text("view,X,Y,Z,u,v\n0,0,0,0,10,20\n3,0,0,0,1,2\n")
    with pytest.raises(ValueError, match=r"c\.csv: view 3 has no row in p\.csv"):
        import_correspondences(tmp_path / "p.csv", tmp_path / "c.csv", (640, 480))


def test_a_letter_and_its_accent_may_be_apart_in_the_name_of_a_picture(folder):
    """Archives that a Mac wrote have them apart, tables have them in one."""
    name = "Gr\u00f6\u00dfe"
    table = folder / "poses.csv"
    table.write_text(table.read_text().replace("\n1,", f"\n{name},"), encoding="utf-8")
    apart = unicodedata.normalize("NFD", name)
    assert apart != name
    (folder / "images/1.png").rename(folder / f"images/{apart}.png")
    data = load_dataset(folder)
    assert name in data.view_ids
    assert np.asarray(data.visible)[data.view_ids.index(name)].all()


def test_pictures_in_folders_of_the_stated_folder_are_found_to_be_there(folder):
    (folder / "images/first").mkdir()
    for picture in (folder / "images").glob("*.png"):
        picture.rename(folder / "images/first" / picture.name)
    with pytest.raises(FileNotFoundError, match=r"such as first/0\.png: put them all into one"):
        load_dataset(folder)
