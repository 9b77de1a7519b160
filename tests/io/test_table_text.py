"""Tables as spreadsheets of several countries write them are read to the same poses."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from shared_data import shared_case

import smartview_jax as sv
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.io import import_correspondences, read_viewpoints, write_viewpoints
from smartview_jax.io.csv_tables import parse_numbers, read_table, write_table
from smartview_jax.io.folder_description import DescribedFolder
from smartview_jax.io.poses import read_poses
from smartview_jax.io.robot_readings import suffix_in_names
from smartview_jax.io.table_text import named_unit
from smartview_jax.robots import kuka_lwr4
from smartview_jax.simulation import random_scene
from smartview_jax.targets import Chessboard, CircleGrid

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
    "minus signs": (PLAIN.replace("-", "\u2212").encode(), "with Unicode minus signs"),
    "some units": (PLAIN.replace("x,y,z", "X [mm],Y (mm),z").encode(), "'X .mm.' as x_mm"),
}


def poses(path):
    """The views and poses of a table, and what was seen in it."""
    entry = {"file": path.name, **STATED}
    read = read_poses(path.parent, entry, "raise")
    assert not read.masked_views
    return read.view_ids, host_matrices(read.poses), read.notes


@pytest.mark.parametrize("form", WRITTEN)
def test_every_way_of_writing_a_table_gives_the_same_poses(tmp_path, form):
    content, seen = WRITTEN[form]
    (tmp_path / "plain.csv").write_text(PLAIN)
    (tmp_path / "poses.csv").write_bytes(content)
    views, actual, (note,) = poses(tmp_path / "poses.csv")
    expected_views, expected, notes = poses(tmp_path / "plain.csv")
    assert views == expected_views
    assert notes == ()
    np.testing.assert_array_equal(actual, expected)
    assert re.search(seen, note), note


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("view;x\n0;1,234\n1;567\n", "may be a decimal comma or separate thousands: write numbers"),
        ("view;x\n0;1,234,567\n", "'1,234,567' has several commas"),
        ("view;x;y\n0;1,25;2.5\n", "'1,25' has a comma and '2.5' a decimal point"),
        ("view,x\n0,1,25\n", "decimal commas in a table separated by commas"),
        ("view,x [km]\n0,1\n", r"missing x \(found 'x \[km\]', in an unexpected unit"),
        ("view;x;y\n0;1.234,5;2.5\n", "'1.234,5' has a comma and '2.5' a decimal point"),
        ("view;x;y\n0;1.234,5;1.234\n", "'1.234,5' has a comma and '1.234' a decimal point"),
        ("view;x;y\n0;1,234.5;1.234,5\n", "'1.234,5' has a comma and '1,234.5' a decimal point"),
        ("view,x,y\n0,1,234.5,1\n", "write numbers without thousands separators"),
        ('view,x\n"a\nb",1\n', "row 1 has a view, 'a\\\\nb' is no name: .* not printable"),
        ("view,x\na\u2028b,1\n", "row 1 has a view, .* is no name: .* not printable"),
        ("view,x\n../a,1\n", "row 1 has a view, .* would lead out of its folder"),
        ("view,x,X\n0,1,2\n", None),
    ],
)
def test_two_readings_are_refused_with_the_cure(tmp_path, content, message):
    (tmp_path / "t.csv").write_text(content)
    if message is None:
        assert read_table(tmp_path / "t.csv", ("view", "x")).rows[0]["x"] == "1"
        return
    with pytest.raises(ValueError, match=message):
        read_table(tmp_path / "t.csv", ("view", "x"))


@pytest.mark.parametrize(
    ("written", "number", "seen"),
    [
        ("1.234,5", 1234.5, "with points between thousands; with a decimal comma"),
        ("-1.234.567,5", -1234567.5, "with points between thousands; with a decimal comma"),
        ("1,234.5", 1234.5, "with commas between thousands"),
        ("1\u00a0234,5", 1234.5, "with blanks or apostrophes between thousands; with a decimal"),
        ("1\u202f234\u202f567", 1234567.0, "with blanks or apostrophes between thousands"),
        ("1'234.5", 1234.5, "with blanks or apostrophes between thousands"),
        ("\u22121,5e\u22123", -0.0015, "with Unicode minus signs; with a decimal comma"),
        ("\u22121.5", -1.5, "with Unicode minus signs"),
        ("1 234", None, None),
        ("1.234 567,5", None, None),
    ],
)
def test_numbers_are_read_as_several_countries_write_them(tmp_path, written, number, seen):
    (tmp_path / "t.csv").write_text(f"view;x\n0;{written}\n", encoding="utf-8")
    table = read_table(tmp_path / "t.csv", ("view", "x"))
    if number is None:
        with pytest.raises(ValueError, match="not a number"):
            parse_numbers(table.path, table.rows[0], ("x",), "0")
        return
    assert parse_numbers(table.path, table.rows[0], ("x",), "0") == number
    assert seen in table.notes[0]


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


@pytest.fixture
def saved_with_joints(tmp_path):
    target, arm = CircleGrid(3, 4, 0.01), kuka_lwr4()
    pixels = 100.0 + 3000.0 * target.points[:, :2] + np.array([0.0, 40.0, 90.0])[:, None, None]
    joints = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 7))
    data = sv.Dataset.from_arrays(
        target.points, pixels, None, (640, 480), target=target, joints=joints, arm=arm
    )
    sv.save_dataset(data, tmp_path)
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
    pattern = {"pictures": {"pattern": "images/{view}.png"}}
    folder = DescribedFolder(tmp_path, pattern, tmp_path / "dataset.yaml")
    assert suffix_in_names(folder, ["00.png", "01.png"]) == ".png"
    assert suffix_in_names(folder, ["00.png", "01"]) == ""
    bare = folder._replace(content={"pictures": {"pattern": "images/{view}"}})
    assert suffix_in_names(bare, ["00.png"]) == ""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "00.png.png").touch()
    assert suffix_in_names(folder, ["00.png", "01.png"]) == ""


@pytest.mark.parametrize("suffixed", ["poses.csv", "joints.csv", "detections.csv"])
def test_tables_whose_names_differ_by_a_pictures_suffix_are_of_the_same_views(
    saved_with_joints, suffixed
):
    expected = sv.load_dataset(saved_with_joints)
    path = saved_with_joints / suffixed
    header, *rows = path.read_text().splitlines()
    renamed = [re.sub(r"^(\d+)", r"\1.png", row) for row in rows]
    path.write_text("\n".join([header, *renamed]) + "\n")
    data = sv.load_dataset(saved_with_joints)
    np.testing.assert_array_equal(data.pixels, expected.pixels)
    np.testing.assert_array_equal(data.joints, expected.joints)
    assert all("by the picture suffix" in note for note in data.notes)
    assert len(data.notes) == (2 if suffixed == "poses.csv" else 1)
    # Names that are other names are refused as before.
    path.write_text("\n".join([header, *(row.replace("0.png", "x.png") for row in renamed)]))
    with pytest.raises(ValueError, match=r"x\.png"):
        sv.load_dataset(saved_with_joints)


@pytest.mark.parametrize("zeros", ["0", "00"])
def test_zeros_that_a_spreadsheet_removes_from_names_are_no_other_views(saved, zeros):
    expected = sv.load_dataset(saved)
    header, *rows = (saved / "detections.csv").read_text().splitlines()
    padded = "\n".join([header, *(zeros + row for row in rows)]) + "\n"
    (saved / "detections.csv").write_text(padded)
    data = sv.load_dataset(saved)
    np.testing.assert_array_equal(data.pixels, expected.pixels)
    assert "leading zeros and were matched" in data.notes[0]
    header, *rows = (saved / "poses.csv").read_text().splitlines()
    (saved / "poses.csv").write_text("\n".join(rows) + "\n")
    with pytest.raises(ValueError, match=r"its first row, .* has numbers: write a header above it"):
        sv.load_dataset(saved)


def test_correspondences_and_viewpoints_say_how_they_were_read(tmp_path):
    columns = [f"m{i}{j}" for i in range(4) for j in range(4)]
    write_table(tmp_path / "p.csv", ("view", *columns), [["0.jpg", *map(float, np.eye(4).ravel())]])
    points = [(0.1 * k, 0.1 * (k % 3), 0.0) for k in range(6)]
    rows = [("0", *point, 100.0 + 1e3 * point[0], 100.0 + 1e3 * point[1]) for point in points]
    write_table(tmp_path / "c.csv", ("view", "X", "Y", "Z", "u", "v"), rows)
    text = (tmp_path / "c.csv").read_text()
    (tmp_path / "c.csv").write_text(text.replace(",", ";").replace(".", ","))
    notes = import_correspondences(tmp_path / "p.csv", tmp_path / "c.csv", (640, 480)).notes
    assert notes[0] == "c.csv was read separated by semicolons; with a decimal comma"
    assert "such as 0 and 0.jpg" in notes[1]
    write_viewpoints(tmp_path / "v.csv", host_transforms(np.eye(4)[None]))
    text = (tmp_path / "v.csv").read_text()
    (tmp_path / "v.csv").write_text(text.replace(",", "\t"))
    assert read_viewpoints(tmp_path / "v.csv").notes == ("v.csv was read separated by tabs",)


def test_tables_are_read_once(saved, monkeypatch):
    opened, read_bytes = [], Path.read_bytes
    monkeypatch.setattr(
        Path, "read_bytes", lambda path: opened.append(path.name) or read_bytes(path)
    )
    sv.load_dataset(saved)
    assert sorted(opened) == ["detections.csv", "poses.csv"]


def test_shared_tables_have_the_same_poses():
    folder = shared_case("tables")
    expected = poses(folder / "blank_rows.csv")[1]
    names = sorted(path.name for path in folder.glob("*.csv"))
    assert len(names) == 8
    for name in names:
        np.testing.assert_allclose(poses(folder / name)[1], expected, atol=1e-12, err_msg=name)


def test_a_comma_at_the_end_of_one_row_may_be_a_decimal_one(tmp_path):
    """With an empty last column such a row could be read with a gap, and a number cut in two."""
    path = tmp_path / "table.csv"
    path.write_text("view,u,v,note\n0,1.5,2.5,\n1,3.5,4,25,\n")
    with pytest.raises(ValueError, match=r"table\.csv: row 2 has 5 fields, the header 4"):
        read_table(path, ("view", "u", "v"))
    path.write_text("view,u,v,note\n0,1.5,2.5,,\n1,3.5,4.25,,\n")
    assert [row["v"] for row in read_table(path, ("view", "u", "v")).rows] == ["2.5", "4.25"]


def test_a_column_of_brackets_is_read_at_once():
    """A regular expression with several ways to match took minutes."""
    assert named_unit("[" * 1_000_000) is None
    assert named_unit("[" * 1_000_000 + "]") == ("", "[" * 999_999)


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        ("X [mm]", ("X", "mm")),
        ("A(°)", ("A", "deg")),
        ("X (tool) [ mm ]", ("X (tool)", "mm")),
        ("X []", ("X", "")),
        ("X", None),
        ("[mm] X", None),
        ("X mm]", None),
        ("", None),
    ],
)
def test_units_of_columns(column, expected):
    assert named_unit(column) == expected
