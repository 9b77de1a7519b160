"""Poses are looked up as tf2 does: along the chain of frames, and between two stamps."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import host_exponentials
from smartview_jax.recordings import TransformTree
from smartview_jax.recordings.tag_messages import tag_poses

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
SECOND = 1_000_000_000


def numbers(pose):
    return (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())


def about_z(degrees):
    return tuple(Rotation.from_euler("z", degrees, degrees=True).as_quat())


def test_between_two_stamps_linearly_and_by_the_shorter_arc():
    tree = TransformTree()
    tree.add("base", "tool", 2 * SECOND, (2.0, 0.0, 0.0, *about_z(170.0)))
    # The same rotation as -170 degrees; the shorter arc leads over 180.
    tree.add("base", "tool", 4 * SECOND, (4.0, 1.0, 0.0, *about_z(190.0)))
    tree.add("base", "tool", 4 * SECOND, (9.0, 9.0, 9.0, *about_z(0.0)))
    chain = tree.chain("base", "tool")
    times = np.array([1, 2, 2, 3, 4, 5]) * SECOND + np.array([0, 0, SECOND // 2, 0, 0, 0])
    poses = chain.at(times)
    assert np.isnan(poses[[0, 5]]).all()
    np.testing.assert_allclose(poses[1:5, :2, 3], [[2, 0], [2.5, 0.25], [3, 0.5], [4, 1]])
    angles = np.rad2deg(np.arctan2(poses[1:5, 1, 0], poses[1:5, 0, 0]))
    np.testing.assert_allclose(angles % 360.0, [170.0, 175.0, 180.0, 190.0])


def test_a_chain_goes_up_to_the_common_frame_and_down():
    """world - left - base, world - right - tool; the right one turns."""
    poses = host_exponentials(np.random.default_rng(0).normal(size=(5, 6)))
    left, base, right, later, tool = poses
    tree = TransformTree()
    tree.add("world", "left", 0, numbers(left), static=True)
    tree.add("left", "base", 0, numbers(base), static=True)
    tree.add("world", "right", 0, numbers(right))
    tree.add("world", "right", SECOND, numbers(later))
    tree.add("right", "tool", 7 * SECOND, numbers(tool), static=True)
    chain = tree.chain("/base", "tool")
    assert chain.words() == "base - left - world - right - tool"
    np.testing.assert_array_equal(chain.stamps, [0, SECOND])
    for pose, moving in zip(chain.at(chain.stamps), (right, later), strict=True):
        expected = np.linalg.inv(left @ base) @ moving @ tool
        np.testing.assert_allclose(pose, expected, atol=1e-12)


def test_frames_that_lead_nowhere_are_named():
    tree = TransformTree()
    tree.add("base", "tool", 0, IDENTITY)
    tree.add("map", "table", 0, IDENTITY)
    with pytest.raises(ValueError, match="tool and table are not connected in tf: tool leads to b"):
        tree.chain("tool", "table")
    tree.add("map", "tool", 0, IDENTITY)
    with pytest.raises(ValueError, match="frame tool has two parents in tf, base and map"):
        tree.chain("base", "tool")
    tree.add("table", "map", 0, IDENTITY)
    with pytest.raises(ValueError, match="frames table, map are in a circle"):
        tree.chain("base", "table")


@pytest.mark.parametrize("wrong", [(0.0,) * 7, (np.nan, *IDENTITY[1:]), (*IDENTITY[:6], 2.0)])
def test_a_wrong_pose_is_named(wrong):
    with pytest.raises(ValueError, match="transform of tool in base: expected a position and a un"):
        TransformTree().add("base", "tool", 0, wrong)


def tag(x):
    position = SimpleNamespace(x=x, y=0.0, z=0.5)
    return SimpleNamespace(
        position=position, orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    )


def test_detectors_state_a_tags_pose_in_several_ways():
    nested = SimpleNamespace(pose=SimpleNamespace(pose=tag(0.1)))
    apriltag = SimpleNamespace(detections=[SimpleNamespace(id=[7], pose=nested)])
    aruco = SimpleNamespace(markers=[SimpleNamespace(id=7, pose=nested.pose)])
    lists = SimpleNamespace(marker_ids=[7], poses=[tag(0.1)])
    transform = SimpleNamespace(translation=tag(0.1).position, rotation=tag(0.1).orientation)
    fiducial = SimpleNamespace(transforms=[SimpleNamespace(fiducial_id=7, transform=transform)])
    expected = (0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0)
    for message in (apriltag, aruco, lists, fiducial):
        assert list(tag_poses(message)) == [(7, expected)]
    for message in (nested.pose, nested, SimpleNamespace(transform=transform)):
        assert list(tag_poses(message)) == [(None, expected)]
    with pytest.raises(ValueError, match="its messages have no poses"):
        list(tag_poses(SimpleNamespace(detections=[SimpleNamespace(id=7, corners=[])])))
