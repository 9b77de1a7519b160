"""Kalibr's own file describes the board of a data set."""

import pytest

from smartview_jax.files import dump_yaml
from smartview_jax.io import read_april_grid, read_folder_description
from smartview_jax.targets import AprilGrid

KALIBR_FILE = """target_type: 'aprilgrid' #gridtype
tagCols: 6               #number of apriltags
tagRows: 5               #number of apriltags
tagSize: 0.088           #size of apriltag, edge to edge [m]
tagSpacing: 0.3          #ratio of space between tags to tagSize
"""


def description(folder, target):
    (folder / "target.yaml").write_text(KALIBR_FILE)
    content = {
        "smartview_dataset": 1,
        "camera": {"image_size": [640, 480]},
        "target": target,
        "poses": {
            "file": "poses.csv",
            "codec": "matrix",
            "length_unit": "m",
            "angle_unit": "rad",
            "direction": "base_from_tool",
        },
        "pictures": {"pattern": "images/{view}.png"},
    }
    (folder / "dataset.yaml").write_text(dump_yaml(content))
    return folder


def test_the_file_of_kalibr_is_the_target(tmp_path):
    expected = AprilGrid(5, 6, 0.088, 0.3)
    folder = description(tmp_path, {"kind": "aprilgrid", "file": "target.yaml"})
    assert read_april_grid(folder / "target.yaml") == expected
    assert read_folder_description(folder).target == expected
    numbers = {"kind": "aprilgrid", "rows": 5, "columns": 6, "size": 0.088, "spacing": 0.3}
    assert read_folder_description(description(tmp_path, numbers)).target == expected


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (
            {"kind": "aprilgrid"},
            "an aprilgrid needs rows, columns, size, spacing, or the entry file",
        ),
        ({"kind": "aprilgrid", "file": "target.yaml", "rows": 6}, "already stated in the file"),
        ({"kind": "aprilgrid", "file": "nowhere.yaml"}, r"nowhere\.yaml: no such file"),
        (
            {"kind": "aprilgrid", "rows": 6, "columns": 6, "size": 0.03, "spacing": 9.0},
            "a fraction of a tag's side, 0 to 1",
        ),
    ],
)
def test_a_wrong_entry_is_named(tmp_path, target, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        read_folder_description(description(tmp_path, target))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("'aprilgrid'", "'checkerboard'", "expected 'aprilgrid', found 'checkerboard'"),
        ("tagSize: 0.088 ", "tagsize: 0.088", r"target\.yaml: .*tagSize"),
        ("0.3 ", "0.0264 m", r"target\.yaml: .*tagSpacing"),
    ],
)
def test_another_file_is_named(tmp_path, old, new, message):
    (tmp_path / "target.yaml").write_text(KALIBR_FILE.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_april_grid(tmp_path / "target.yaml")
