"""A folder of a camera on one hand and a target on another: two tables of poses."""

import dataclasses

import numpy as np
import pytest
import yaml
from text_files import edit
from two_hands_scene import hands_rig, two_hands

from smartview_jax import Calibration, Rig, load_dataset, load_rig, save_dataset, save_rig
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.io import write_new_dataset
from smartview_jax.io.folder_description import read_folder_description
from smartview_jax.simulation import random_two_hand_scene
from smartview_jax.targets import Chessboard

SIZES = {"eye": (640, 480)}
"""Of the pictures of one camera."""


@pytest.fixture
def folder(tmp_path):
    save_dataset(two_hands(0).data, tmp_path, "ur")
    return tmp_path


def test_what_was_saved_is_loaded(folder):
    data, loaded = two_hands(0).data, load_dataset(folder)
    assert (loaded.mount, loaded.view_ids) == ("hand_to_hand", data.view_ids)
    np.testing.assert_allclose(loaded.pixels, data.pixels, atol=1e-9)
    for name in ("base_from_tool", "other_base_from_other_tool"):
        read, written = (host_matrices(getattr(d.hands, name)) for d in (loaded, data))
        np.testing.assert_allclose(read, written, atol=1e-12)
    # Where the bases are is not in the folder.
    np.testing.assert_allclose(host_matrices(loaded.base_from_other_base), np.eye(4), atol=1e-12)


def test_the_tables_are_matched_by_name(folder):
    """The second table in another order, and with a state that has no picture."""
    path = folder / "other_poses.csv"
    head, *rows = path.read_text().splitlines()
    rows = [*rows[::-1], rows[0].replace("0,", "extra,", 1)]
    path.write_text("\n".join([head, *rows]) + "\n")
    edit(folder / "dataset.yaml", "rows: 10}\nend", "rows: 11}\nend")
    loaded = load_dataset(folder)
    expected = host_matrices(two_hands(0).data.hands.other_base_from_other_tool)
    read = host_matrices(loaded.hands.other_base_from_other_tool)
    np.testing.assert_allclose(read, expected, atol=1e-12)


def test_a_view_without_a_pose_of_the_other_arm_is_named(folder):
    path = folder / "other_poses.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], *lines[4:]]) + "\n")
    edit(folder / "dataset.yaml", "rows: 10}\nend", "rows: 9}\nend")
    with pytest.raises(ValueError, match=r"other_poses\.csv: no pose for the view 2"):
        load_dataset(folder)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mount: hand_to_hand", "mount: eye_in_hand", "other_poses: expected the poses of the arm"),
        (
            "mount: hand_to_hand",
            "mount: hand_to_hand\nbase_from_world: {translation: [0, 0, 0], "
            "yaw_pitch_roll_deg: [0, 0, 0]}",
            "base_from_world: a data set with mount hand_to_hand has none",
        ),
        ("other_poses:", "others:", "others"),
    ],
)
def test_wrong_descriptions_are_named(folder, old, new, message):
    edit(folder / "dataset.yaml", old, new)
    with pytest.raises(ValueError, match=message):
        load_dataset(folder)


def test_a_symmetric_board_is_refused(folder):
    """Two arms do not tell the numberings of its corners apart before their bases are known."""
    edit(folder / "dataset.yaml", "detections: {rows:", "pictures: {pattern: '{view}.png'}\nx: {r:")
    text = (folder / "dataset.yaml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("x:")]
    (folder / "dataset.yaml").write_text("\n".join(lines).replace("rows: 4", "rows: 5") + "\n")
    with pytest.raises(ValueError, match="must not look the same when turned, as this Chessboard"):
        load_dataset(folder)


def test_no_view_is_planned_or_captured_for_two_arms(folder):
    with pytest.raises(ValueError, match=r"dataset\.yaml: mount: expected one arm"):
        read_folder_description(folder)


def test_a_calibration_file_has_three_transforms(tmp_path):
    truth = two_hands(0).calibration
    truth.save(tmp_path / "calibration.yaml")
    read = Calibration.load(tmp_path / "calibration.yaml")
    assert read.mount == "hand_to_hand"
    for name, transform in truth.transforms.items():
        np.testing.assert_allclose(
            read.transforms[name].wxyz_xyz, transform.wxyz_xyz, rtol=0.0, atol=1e-15
        )
    assert "base_from_other_base" in repr(read)
    edit(tmp_path / "calibration.yaml", "base_from_other_base", "other_base")
    with pytest.raises(ValueError, match="base_from_other_base"):
        Calibration.load(tmp_path / "calibration.yaml")


def test_a_rig_with_a_camera_on_one_hand_is_read_again(tmp_path):
    """The poses of one hand are in one table, whether one camera or another saw its target."""
    rig, _ = hands_rig(0)
    save_rig(rig, tmp_path, "ur")
    assert sorted(path.parent.name for path in tmp_path.glob("*/poses.csv")) == ["left", "right"]
    loaded = load_rig(tmp_path)
    assert dict(loaded.arms) == {"wrist": "left+right", "fixed": "right"}
    assert loaded.targets["wrist"] == loaded.targets["fixed"]
    for name in ("base_from_tool", "other_base_from_other_tool"):
        read, written = (
            host_matrices(getattr(own.cameras["wrist"].hands, name)) for own in (loaded, rig)
        )
        np.testing.assert_allclose(read, written, atol=1e-12)
    fixed = loaded.cameras["fixed"]
    assert (fixed.mount, fixed.view_ids) == ("eye_to_hand", rig.cameras["fixed"].view_ids)


def test_a_state_that_one_camera_cannot_use_keeps_its_pose_for_the_other(tmp_path):
    """The left arm did not tell its pose in a state in which both cameras saw the right hand."""
    rig, _ = hands_rig(0)
    wrist = rig.cameras["wrist"]
    right = host_matrices(wrist.hands.other_base_from_other_tool)[:6]
    fixed = dataclasses.replace(
        rig.cameras["fixed"], base_from_tool=as_se3(right), view_ids=wrist.view_ids[:6]
    )
    save_rig(Rig({"wrist": wrist, "fixed": fixed}, arms=dict(rig.arms)), tmp_path, "ur")
    path = tmp_path / "left/poses.csv"
    lines = path.read_text().splitlines()
    view = lines[3].split(",")[0]
    lines[3] = ",".join([view, *["nan"] * lines[3].count(",")])
    path.write_text("\n".join(lines) + "\n")
    loaded = load_rig(tmp_path, bad_views="mask")
    assert [name for name, _ in loaded.cameras["wrist"].masked_views] == [view]
    assert loaded.cameras["fixed"].masked_views == ()
    read = host_matrices(loaded.cameras["wrist"].hands.other_base_from_other_tool)[:6]
    np.testing.assert_allclose(read, right, atol=1e-12)


def test_points_of_a_symmetric_board_that_are_numbered_are_read_again(tmp_path):
    """A table of points says which is which, where pictures do not."""
    board = Chessboard(6, 2, 0.0125)
    assert len(board.symmetries) > 1
    data = random_two_hand_scene(0, 4, board).data
    save_rig(Rig({"eye": data}, arms={"eye": ("left", "right")}), tmp_path, "ur")
    loaded = load_rig(tmp_path).cameras["eye"]
    np.testing.assert_allclose(loaded.pixels, data.pixels, atol=1e-9)


@pytest.mark.parametrize("arms", ["left+left", "left+right+third"])
def test_arms_that_are_no_pair_are_refused_before_a_folder_is_begun(tmp_path, arms):
    with pytest.raises(ValueError, match=r"camera eye: expected an arm, or two such as left"):
        write_new_dataset(tmp_path, "ur", "charuco", "eye_in_hand", SIZES, arms={"eye": arms})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (", target_arm: right", "", "target_arm: expected the arm that carries the target for mo"),
        ("target_arm: right", "target_arm: left", "target_arm: expected another arm than the cam"),
        ("target_arm: right", "target_arm: third", "target_arm: expected one of left, right, fou"),
        ("mount: hand_to_hand", "mount: eye_in_hand", "target_arm: expected the arm that carries"),
    ],
)
def test_a_wrong_arm_of_the_target_is_named(tmp_path, old, new, message):
    path = write_new_dataset(
        tmp_path, "ur", "chessboard", "eye_to_hand", SIZES, arms={"eye": "left+right"}
    )
    edit(path, old, new)
    with pytest.raises(ValueError, match=message):
        load_rig(tmp_path)


def test_a_rig_with_a_camera_on_one_hand_is_begun(tmp_path):
    arms = {"wrist": "left+right", "fixed": "right"}
    sizes = dict.fromkeys(arms, (640, 480))
    path = write_new_dataset(tmp_path, "kuka", "charuco", "eye_to_hand", sizes, arms=arms)
    cameras = yaml.safe_load(path.read_text())["cameras"]
    assert cameras["wrist"] == {
        "image_size": [640, 480],
        "mount": "hand_to_hand",
        "arm": "left",
        "target_arm": "right",
    }
    assert cameras["fixed"] == {"image_size": [640, 480], "arm": "right"}
    assert (tmp_path / "left/poses.csv").is_file()
    # Without a camera on a hand nothing would tell where the arms are.
    with pytest.raises(ValueError, match="cameras next to several arms see no target in common"):
        write_new_dataset(
            tmp_path, "kuka", "charuco", "eye_to_hand", sizes, arms={"wrist": "a", "fixed": "b"}
        )
