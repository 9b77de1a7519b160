import numpy as np
import pytest
from text_files import edit

from smartview_jax import Dataset, load_dataset, save_dataset
from smartview_jax.robots import SerialArm, kuka_lwr4
from smartview_jax.targets import CircleGrid

TARGET = CircleGrid(3, 4, 0.01)
SEEN = 100.0 + 3000.0 * TARGET.points[:, :2]


@pytest.fixture
def data():
    rng = np.random.default_rng(0)
    pixels = SEEN + rng.uniform(0.0, 200.0, (3, 1, 2))
    joints = rng.uniform(-1.0, 1.0, (3, 7))
    return Dataset.from_arrays(
        TARGET.points, pixels, None, (640, 480), target=TARGET, joints=joints, arm=kuka_lwr4()
    )


@pytest.fixture
def folder(data, tmp_path):
    save_dataset(data, tmp_path)
    return tmp_path


def test_joints_and_arm_come_back(data, folder):
    again = load_dataset(folder)
    np.testing.assert_array_equal(again.joints, data.joints)
    np.testing.assert_array_equal(again.base_from_tool.wxyz_xyz, data.base_from_tool.wxyz_xyz)
    assert again.arm is not None
    np.testing.assert_array_equal(again.arm.alpha, data.arm.alpha)


def test_joints_alone_in_degrees_with_a_named_arm(data, folder):
    """A folder as a person would write it: rows in another order, no poses."""
    text = (folder / "dataset.yaml").read_text()
    kept = text[: text.index("poses:")]
    entry = "joints: {file: q.csv, angle_unit: deg, length_unit: m, arm: kuka_lwr4}\n"
    (folder / "dataset.yaml").write_text(kept + entry + "end: smartview_dataset\n")
    rows = [
        ",".join(map(str, (view, *np.rad2deg(row))))
        for view, row in zip(data.view_ids, np.asarray(data.joints), strict=True)
    ]
    header = "view," + ",".join(f"q{1 + k}" for k in range(7))
    (folder / "q.csv").write_text("\n".join([header, *rows[::-1]]) + "\n")
    (folder / "poses.csv").unlink()
    again = load_dataset(folder)
    assert again.view_ids == data.view_ids[::-1]
    np.testing.assert_allclose(again.joints, data.joints[::-1], atol=1e-14)
    np.testing.assert_array_equal(again.pixels, data.pixels[::-1])


def test_a_gantrys_joint_has_a_length(tmp_path):
    arm = SerialArm([0.0, 0.0], [0.1, 0.2], [0.0, 0.5], [0.0, 0.3], prismatic=[True, False])
    pixels = np.stack([SEEN] * 3)
    joints = np.array([[0.25, 0.5], [0.3, 0.6], [0.4, 0.7]])
    data = Dataset.from_arrays(
        TARGET.points, pixels, None, (640, 480), target=TARGET, joints=joints, arm=arm
    )
    save_dataset(data, tmp_path)
    edit(tmp_path / "dataset.yaml", "length_unit: m\n  arm", "length_unit: mm\n  arm")
    lines = (tmp_path / "joints.csv").read_text().splitlines()
    moved = [lines[0]]
    for line in lines[1:]:
        view, slide, turn = line.split(",")
        moved.append(f"{view},{1e3 * float(slide)},{turn}")
    (tmp_path / "joints.csv").write_text("\n".join(moved) + "\n")
    np.testing.assert_allclose(load_dataset(tmp_path).joints, joints, rtol=1e-14)


CASES = {
    "unit": (
        "dataset.yaml",
        "angle_unit: rad\n  length_unit: m\n  arm",
        "length_unit: m\n  arm",
        "entry 'joints.angle_unit' is missing",
    ),
    "which": ("joints.csv", "q3", "q8", "joints.csv: .*missing q3"),
    "number": ("joints.csv", "\n1,", "\n1,x", "view 1: q1 is 'x.*not a number"),
    "view": ("joints.csv", "\n2,", "\n7,", "have different views: 2, 7"),
    "twice": ("joints.csv", "\n2,", "\n1,", "view 1 has more than one row"),
    "arm": (
        "dataset.yaml",
        "convention: standard",
        "convention: ours",
        "joints.arm.convention is one of standard, modified",
    ),
    "part": ("dataset.yaml", "alpha:", "alfa:", "'alfa'; did you mean 'alpha'"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_named(folder, case):
    name, old, new, message = CASES[case]
    edit(folder / name, old, new)
    with pytest.raises(ValueError, match=message):
        load_dataset(folder)


def test_an_unknown_arm_is_named(folder):
    text = (folder / "dataset.yaml").read_text()
    kept = text[: text.index("joints:")]
    entry = "joints: {file: joints.csv, angle_unit: rad, length_unit: m, arm: robby}\n"
    (folder / "dataset.yaml").write_text(kept + entry + "end: smartview_dataset\n")
    with pytest.raises(ValueError, match=r"joints\.arm: arm is one of kuka_lwr4, .*'robby'"):
        load_dataset(folder)


def test_counts_of_an_encoder_are_no_radians(folder):
    header, *rows = (folder / "joints.csv").read_text().splitlines()
    counts = [",".join((row.split(",")[0], *["-941"] * 7)) for row in rows]
    (folder / "joints.csv").write_text("\n".join([header, *counts]) + "\n")
    with pytest.raises(ValueError, match=r"q1 is -941 .*more than 100: degrees .* or counts"):
        load_dataset(folder)


def test_a_joint_that_the_arm_does_not_have_is_named(folder):
    """The table of a seven-axis arm with a six-axis arm's parameters would be read by halves."""
    lines = (folder / "joints.csv").read_text().splitlines()
    (folder / "joints.csv").write_text(
        "\n".join([f"{lines[0]},q8", *(f"{line},0.5" for line in lines[1:])]) + "\n"
    )
    (note,) = load_dataset(folder).notes
    assert note.startswith("joints.csv has q8 too, which the stated arm of 7 joints has not")
