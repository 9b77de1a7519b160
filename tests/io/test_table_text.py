"""Tables as spreadsheets of several countries write them are read to the same poses."""

import dataclasses
import re

import numpy as np
import pytest
from shared_data import shared_case

import smartview_jax as sv
from smartview_jax.geometry import host_matrices
from smartview_jax.io.csv_tables import read_table, table_notes
from smartview_jax.io.poses import read_poses
from smartview_jax.simulation import random_scene
from smartview_jax.targets import Chessboard

PLAIN = (
    "view,x,y,z,A,B,C\n00,560.583,249.41,-231.5,-54.3443,32.7,-0.4\n01,588.8,168.9,-244.6,1,2,3\n"
)
STATED = {
    "codec": "kuka_abc",
    "length_unit": "mm",
    "angle_unit": "deg",
    "direction": "base_from_tool",
}
SEMICOLONS = PLAIN.replace(",", ";").replace(".", ",")
WRITTEN = {
    "semicolons": (SEMICOLONS.encode("utf-8-sig"), "separated by semicolons; with a decimal comma"),
    "tabs": (PLAIN.replace(",", "\t").encode(), "separated by tabs"),
    "utf16": (SEMICOLONS.replace(";", "\t").encode("utf-16"), "in the encoding UTF-16"),
    "no mark": (SEMICOLONS.encode(), "decimal comma"),
    "quoted": (
        b'view,x,y,z,A,B,C\n00,"560,583","249,41","-231,5","-54,3443","32,7","-0,4"\n'
        b'01,"588,8","168,9","-244,6",1,2,3\n',
        "decimal comma",
    ),
    "excel": (b"sep=;\n" + SEMICOLONS.encode(), "separated by semicolons; with a decimal comma"),
    "blank before quotes": (
        b'view, x, y, z, A, B, C\n00, "560,583", "249,41", "-231,5", "-54,3443", "32,7", "-0,4"\n'
        b'01, "588,8", "168,9", "-244,6", 1, 2, 3\n',
        "decimal comma",
    ),
    "blank": ((PLAIN + ",,,,,,\n\n,,,,,,\n").encode(), "2 rows without a value left out"),
    "trailing": (
        PLAIN.replace("C\n", "C,\n").replace("4\n", "4,\n").replace("3\n", "3,\n").encode(),
        "separators at the ends of rows ignored",
    ),
    "trailing rows": (PLAIN.replace("4\n", "4,\n").encode(), "separators at the ends"),
    "units": (
        PLAIN.replace("view,x,y,z,A,B,C", "View,X [mm],Y [mm],Z [mm],A [°],B (deg),C [°]").encode(
            "cp1252"
        ),
        "in the encoding CP1252; columns .*'A .°.' as a_deg",
    ),
    "some units": (PLAIN.replace("x,y,z", "X [mm],Y (mm),z").encode(), "'X .mm.' as x_mm"),
}


def poses(path):
    views, found, masked = read_poses(path.parent, {"file": path.name, **STATED}, "raise")
    assert not masked
    return views, host_matrices(found)


@pytest.mark.parametrize("form", WRITTEN)
def test_every_way_of_writing_a_table_gives_the_same_poses(tmp_path, form):
    content, seen = WRITTEN[form]
    (tmp_path / "plain.csv").write_text(PLAIN)
    (tmp_path / "poses.csv").write_bytes(content)
    views, found = poses(tmp_path / "poses.csv")
    expected_views, expected = poses(tmp_path / "plain.csv")
    assert views == expected_views
    np.testing.assert_array_equal(found, expected)
    (note,) = table_notes(tmp_path / "poses.csv", tmp_path / "plain.csv")
    assert re.search(seen, note), note


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("view;x\n0;1,234\n1;567\n", "may be a decimal comma or separate thousands: write numbers"),
        ("view;x\n0;1,234,567\n", "'1,234,567' has several commas"),
        ("view;x;y\n0;1,25;2.5\n", "'1,25' has a comma and '2.5' a decimal point"),
        ("view,x\n0,1,25\n", "decimal commas in a table separated by commas"),
        ("view,x [km]\n0,1\n", r"missing x \(found 'x \[km\]': a unit"),
        ("view,x,X\n0,1,2\n", None),
    ],
)
def test_two_readings_are_refused_with_the_cure(tmp_path, content, message):
    (tmp_path / "t.csv").write_text(content)
    if message is None:
        assert read_table(tmp_path / "t.csv", ("view", "x"))[0]["x"] == "1"
        return
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / "t.csv", ("view", "x"))


def test_what_is_no_text_is_refused(tmp_path):
    (tmp_path / "t.csv").write_bytes(b"view,x\n\0\0\x81")
    with pytest.raises(ValueError, match="save it as 'CSV UTF-8'"):
        read_table(tmp_path / "t.csv", ("view",))


@pytest.fixture
def saved(tmp_path):
    board = Chessboard(9, 6, 0.004)
    data = dataclasses.replace(random_scene(1, 4, board.points).data, target=board)
    sv.save_dataset(data, tmp_path, "kuka_abc")
    return tmp_path


def test_tables_of_a_data_set_are_named_once_in_its_notes(saved):
    expected = sv.load_dataset(saved)
    assert expected.notes == ()
    for name in ("poses.csv", "detections.csv"):
        text = (saved / name).read_text().replace(",", ";").replace(".", ",")
        (saved / name).write_text(text, encoding="utf-16")
    data = sv.load_dataset(saved)
    np.testing.assert_array_equal(data.pixels, expected.pixels)
    np.testing.assert_array_equal(data.base_from_tool.wxyz_xyz, expected.base_from_tool.wxyz_xyz)
    assert [note.split()[0] for note in data.notes] == ["poses.csv", "detections.csv"]


def test_names_of_views_may_be_those_of_pictures(tmp_path):
    from smartview_jax.io.robot_readings import suffix_in_names

    content = {"pictures": {"pattern": "images/{view}.png"}}
    assert suffix_in_names(tmp_path, content, ["00.png", "01.png"]) == ".png"
    assert suffix_in_names(tmp_path, content, ["00.png", "01"]) == ""
    assert suffix_in_names(tmp_path, {"pictures": {"pattern": "images/{view}"}}, ["00.png"]) == ""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "00.png.png").touch()
    assert suffix_in_names(tmp_path, content, ["00.png", "01.png"]) == ""


def test_shared_tables_have_the_same_poses():
    folder = shared_case("tables")
    expected = poses(folder / "blank_rows.csv")[1]
    names = sorted(path.name for path in folder.glob("*.csv"))
    assert len(names) == 8
    for name in names:
        np.testing.assert_allclose(poses(folder / name)[1], expected, atol=1e-12, err_msg=name)
