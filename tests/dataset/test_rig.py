import dataclasses
import pickle

import numpy as np
import pytest
from fit_scenes import scene_of
from jaxlie import SE3
from tracked_scene import data_of

from smartview_jax import Rig
from smartview_jax.geometry import host_matrices


@pytest.fixture(scope="module")
def data():
    return scene_of(0).data


def test_views_with_one_id_are_one_state(data):
    later = dataclasses.replace(data, view_ids=tuple(str(k + 3) for k in range(data.view_count)))
    moved = SE3(data.base_from_tool.wxyz_xyz)
    rig = Rig({"left": data, "other": dataclasses.replace(data, view_ids=data.view_ids)})
    assert len(rig.view_ids) == data.view_count
    assert rig.state_index["other"].tolist() == list(range(data.view_count))
    with pytest.raises(ValueError, match=r"view '3' is one state of the robot, but its pose in"):
        Rig({"left": data, "later": later})
    apart = dataclasses.replace(later, view_ids=tuple(f"b{k}" for k in range(data.view_count)))
    assert len(Rig({"left": data, "apart": apart}).view_ids) == 2 * data.view_count
    np.testing.assert_allclose(rig.base_from_tool.wxyz_xyz, moved.wxyz_xyz, atol=1e-12)


def test_cameras_on_the_hand_and_next_to_the_arm_see_different_targets(data):
    fixed = dataclasses.replace(data, mount="eye_to_hand")
    rig = Rig({"wrist": data, "table": fixed})
    assert rig.targets == {"wrist": "target_eye_in_hand", "table": "target_eye_to_hand"}
    expected = r"'wrist' \(eye_in_hand\) sees target 'board' on the table, .* on the hand: correct"
    with pytest.raises(ValueError, match=expected):
        Rig({"wrist": data, "table": fixed}, targets={"wrist": "board", "table": "board"})


@pytest.mark.parametrize(
    ("cameras", "targets", "message"),
    [
        ([], None, "expected at least one camera"),
        (["two words"], None, "a camera's name has letters"),
        (["left"], {"right": "board"}, "expected the cameras left, found right"),
        (["left"], {"left": "left"}, "and is no camera's name"),
    ],
)
def test_wrong_names_are_refused(data, cameras, targets, message):
    with pytest.raises(ValueError, match=message):
        Rig(dict.fromkeys(cameras, data), targets)


def test_only_data_sets_with_pictures_make_a_rig(data):
    # The tests' own check of types, which users do not have, is made at the first call only.
    Rig({"left": data})
    with pytest.raises(TypeError, match="camera 'left'"):
        Rig({"left": "folder"})
    with pytest.raises(TypeError, match="tracked poses have no pixels"):
        Rig({"left": data_of(0)})


def test_the_states_of_several_arms_are_apart(data):
    """Views of two arms may have the same names, and different poses."""
    turned = SE3(data.base_from_tool.wxyz_xyz.at[:, 4].add(0.3))
    masks = (("2", "cannot be read"),)
    other = dataclasses.replace(data, base_from_tool=turned, masked_views=masks)
    rig = Rig(
        {"one": data, "two": other, "three": data},
        arms={"one": "left", "two": "right", "three": "left"},
    )
    assert rig.arm_names == ("left", "right")
    assert rig.targets == dict.fromkeys(rig.cameras, "target")
    assert rig.view_ids[:2] == ("left/0", "left/1")
    assert rig.view_ids[-1] == f"right/{data.view_count - 1}"
    assert rig.state_index["three"].tolist() == list(range(data.view_count))
    assert rig.masked_views == (("right/2", "cannot be read"),)
    assert rig.joints is None
    assert repr(rig).startswith(f"<Rig: {2 * data.view_count} robot states of arms left, right;")
    right = rig.of_arm("right")
    assert (tuple(right.cameras), right.view_ids) == (("two",), data.view_ids)
    assert right.of_arm("right") is right
    np.testing.assert_allclose(right.base_from_tool.wxyz_xyz, turned.wxyz_xyz, atol=1e-12)
    masked = rig.mask_views([data.view_count])
    assert not np.asarray(masked.cameras["two"].visible)[0].any()
    assert np.asarray(masked.cameras["one"].visible).any(axis=1).all()
    with pytest.raises(ValueError, match="of_arm: expected an arm of left, right, found 'up'"):
        rig.of_arm("up")


@pytest.mark.parametrize(
    ("targets", "mounts", "arms", "message"),
    [
        ("tt", "hh", {"a": "left"}, "arms: expected the cameras a, b, found a"),
        ("tt", "hh", {"a": "left", "b": "a"}, "an arm's name has letters.*found 'a'"),
        ("rr", "hh", {"a": "left", "b": "r"}, "is no camera's name and no arm's; found 'r'"),
        ("tw", "hh", {"a": "left", "b": "right"}, "no target tells where right and left are"),
        (None, "bb", {"a": "left", "b": "right"}, "no target tells where right and left are"),
        ("tt", "bb", {"a": "left", "b": "right"}, "target 't' is on the hand of 'left' and, for"),
    ],
)
def test_arms_that_cannot_be_placed_are_named(data, targets, mounts, arms, message):
    """Before any fit."""
    mount = {"h": "eye_in_hand", "b": "eye_to_hand"}
    cameras = {
        name: dataclasses.replace(data, mount=mount[key])
        for name, key in zip("ab", mounts, strict=True)
    }
    seen = None if targets is None else dict(zip("ab", targets, strict=True))
    with pytest.raises(ValueError, match=message):
        Rig(cameras, seen, arms)


def test_arms_that_a_third_one_connects_are_one_rig(data):
    cameras = dict.fromkeys("abcd", data)
    targets = {"a": "table", "b": "table", "c": "wall", "d": "wall"}
    rig = Rig(cameras, targets, {"a": "one", "b": "two", "c": "two", "d": "three"})
    assert rig.arm_names == ("one", "two", "three")


def test_one_target_has_one_size(data):
    """Stated points that differ by a factor; other points are another part of the target."""
    larger = dataclasses.replace(data, points=1.02 * data.points)
    match = "camera 'right' states the target 'target' 1.02 times as large as camera 'left' does"
    with pytest.raises(ValueError, match=match):
        Rig({"left": data, "right": larger})
    Rig({"left": data, "right": larger}, {"left": "table", "right": "wall"})
    Rig({"left": data, "right": dataclasses.replace(data, points=data.points + 0.1)})


def test_a_rig_can_be_sent_to_another_process(data):
    between = data.between_hands(host_matrices(data.base_from_tool))
    arms = {"wrist": "left", "other": "right", "eye": ("left", "right")}
    targets = {"wrist": "table", "other": "table", "eye": "tag"}
    rig = Rig({"wrist": data, "other": data, "eye": between}, targets, arms)
    copy = pickle.loads(pickle.dumps(rig))
    assert (copy.arms, copy.targets, copy.view_ids) == (rig.arms, rig.targets, rig.view_ids)
    np.testing.assert_array_equal(copy.cameras["eye"].pixels, between.pixels)
