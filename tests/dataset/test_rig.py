import dataclasses

import numpy as np
import pytest
from fit_scenes import scene_of
from jaxlie import SE3
from tracked_scene import data_of

from smartview_jax import Rig


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


def test_cameras_on_the_hand_and_beside_the_arm_see_different_targets(data):
    fixed = dataclasses.replace(data, mount="eye_to_hand")
    rig = Rig({"wrist": data, "table": fixed})
    assert rig.targets == {"wrist": "target_eye_in_hand", "table": "target_eye_to_hand"}
    with pytest.raises(ValueError, match="target 'board' is on the table for cameras on the hand"):
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
    with pytest.raises(TypeError, match="camera 'left'"):
        Rig({"left": "folder"})
    with pytest.raises(TypeError, match="tracked poses have no pixels"):
        Rig({"left": data_of(0)})
