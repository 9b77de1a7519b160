import re

import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import opencv_poses
from jaxlie import SE3
from robot_motions import mirrored
from shared_data import shared_pairs

from smartview_jax import Dataset
from smartview_jax.calibration import mount_from_holder
from smartview_jax.data_checks import find_consistent_views
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.staged import fit_staged
from smartview_jax.targets import Chessboard

VIEWS = 12


@pytest.fixture(scope="module")
def poses():
    """Robot and camera of a scene, with a tenth of a millimetre and of a degree of noise."""
    robot = mount_from_holder("eye_in_hand", random_scene(1, VIEWS).base_from_tool)
    noise = np.random.default_rng(0).normal(size=(VIEWS, 6)) * np.repeat([1e-4, 2e-3], 3)
    truth = paper_calibration()
    seen = SE3(truth.camera_from_mount.wxyz_xyz[None]) @ SE3.exp(jnp.asarray(noise)) @ robot
    return robot, seen @ SE3(truth.holder_from_world.wxyz_xyz[None])


def test_views_that_agree_are_kept(poses):
    kept, words, unsure = find_consistent_views(*poses, jnp.ones(VIEWS))
    assert unsure == ()
    assert kept.all()
    assert words == {}


def test_views_off_by_rotation_and_by_translation_are_left_out(poses):
    robot, seen = poses
    off = jnp.zeros((VIEWS, 6)).at[3, 4].set(0.3).at[8, 0].set(0.05)
    kept, words, _ = find_consistent_views(SE3.exp(off) @ robot, seen, jnp.ones(VIEWS))
    assert set(np.flatnonzero(~kept)) == set(words) == {3, 8}
    assert "17.2 degrees" in words[3]
    assert float(words[8].split("degrees and ")[1].split(" mm")[0]) == pytest.approx(50.0, abs=1.0)
    assert "it fits the pose of no other view either: moved, or a wrong pose?" in words[3]


def test_views_that_hide_each_other_are_left_out(poses):
    """Three rows are in another unit of length: they bend any fit to all views to themselves."""
    robot, seen = poses
    wrong = host_matrices(robot.inverse()).copy()
    wrong[[2, 5, 6], :3, 3] *= 0.1
    kept, words, _ = find_consistent_views(as_se3(wrong).inverse(), seen, jnp.ones(VIEWS))
    assert set(np.flatnonzero(~kept)) == set(words) == {2, 5, 6}


def test_a_view_whose_picture_was_turned_or_mirrored_is_named_as_such(poses):
    robot, seen = poses
    changed = host_matrices(seen).copy()
    changed[3] = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ changed[3]
    changed[8] = mirrored(changed[8], axis=1)
    _, words, _ = find_consistent_views(robot, as_se3(changed), jnp.ones(VIEWS))
    assert words[3].endswith("its picture seems to be turned by 90 degrees: turn it back")
    assert words[8].endswith("top and bottom, swapped): mirror it back")


def test_two_views_that_were_exchanged_are_named_with_each_other(poses):
    robot, seen = poses
    order = np.arange(VIEWS)
    order[[2, 9]] = [9, 2]
    names = [f"picture{k}" for k in range(VIEWS)]
    swapped = SE3(robot.wxyz_xyz[order])
    kept, words, _ = find_consistent_views(swapped, seen, jnp.ones(VIEWS), view_ids=names)
    assert set(np.flatnonzero(~kept)) == {2, 9}
    assert "it fits the pose of view picture9" in words[2]
    assert words[9].endswith("mispaired")


def test_a_view_numbered_from_the_other_end_is_named_so(poses):
    """Counting from the other end of a grid is half a turn about its middle."""
    robot, seen = poses
    half_turns = np.tile(np.diag([-1.0, -1.0, 1.0, 1.0]), (2, 1, 1))
    half_turns[0], half_turns[1, :2, 3] = np.eye(4), [0.08, 0.05]
    camera = host_matrices(seen)
    camera[4] = camera[4] @ half_turns[1]
    off = jnp.zeros((VIEWS, 6)).at[7, 4].set(0.3)
    _, words, _ = find_consistent_views(
        SE3.exp(off) @ robot, as_se3(camera), jnp.ones(VIEWS), turns=half_turns
    )
    assert "numbered from another corner" in words[4]
    assert "it fits the pose of no other view either" in words[7]


def test_a_view_whose_points_are_where_the_others_put_them_is_not_accused(poses):
    """Its own pose is off, as by points that tell it badly: no say in Step 3, and no fault."""
    robot, seen = poses
    off = jnp.zeros((VIEWS, 6)).at[3, 4].set(0.05).at[8, 0].set(0.05)
    seen = SE3.exp(off) @ seen
    px = np.ones(VIEWS)
    px[8] = 70.0
    kept, words, unsure = find_consistent_views(robot, seen, jnp.ones(VIEWS), lambda *_: px)
    assert set(np.flatnonzero(~kept)) == {3, 8}
    assert unsure == (3,)
    assert set(words) == {8}
    assert "its points 70 px off (the median view's 1 px)" in words[8]


def test_a_view_that_is_not_asked_is_not_spoken_of(poses):
    robot, seen = poses
    off = jnp.zeros((VIEWS, 6)).at[3, 4].set(0.3)
    kept, words, _ = find_consistent_views(
        SE3.exp(off) @ robot, seen, jnp.ones(VIEWS).at[3].set(0.0)
    )
    assert list(np.flatnonzero(~kept)) == [3]
    assert words == {}


def test_too_few_views_accuse_none(poses):
    robot, seen = poses
    off = jnp.zeros((VIEWS, 6)).at[3, 4].set(0.3)
    few = jnp.asarray(np.arange(VIEWS) < 7, dtype=float)
    assert find_consistent_views(SE3.exp(off) @ robot, seen, few).reasons == {}


def test_the_staged_fit_does_without_a_mispaired_view(scene, clean_fit):
    wrong = scene.data.base_from_tool.wxyz_xyz
    # Near another view's pose, but not a copy of it.
    wrong = SE3(wrong.at[4].set(wrong[6]).at[4, 4:].add(1e-3))
    data = type(scene.data).from_arrays(
        scene.data.points, scene.data.pixels, wrong, scene.data.image_size
    )
    fit = fit_staged(data)
    assert 4 not in fit.views
    assert not np.asarray(fit.inliers)[4].any()
    ((view, _, text),) = whole(fit)
    assert view == "4"
    assert re.search(
        r"its points .* \(the median view's .* px\): it fits the pose of no other", text
    )
    errors = [
        np.linalg.norm(
            (f.calibration.camera_from_tool.translation())
            - scene.calibration.camera_from_tool.translation()
        )
        for f in (fit, clean_fit)
    ]
    assert errors[0] < 1.5 * errors[1]


def whole(fit):
    return [entry for entry in fit.rejected if entry[1] is None]


def test_real_views_agree():
    """By the poses that OpenCV finds with the lens of the set; the points would acquit views."""
    data, reference = shared_pairs("tampere_synthetic", "cs3_")
    fx, fy, cx, cy, *distortion = reference["K"]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    seen = opencv_poses(data, K, np.array(distortion))
    robot = mount_from_holder(data.mount, data.base_from_tool)
    assert find_consistent_views(robot, seen, jnp.ones(len(data.points))).reasons == {}


FEW = 3


@pytest.fixture(scope="module")
def few_corners():
    """Views of a chessboard; one shows only twelve corners, in one corner of it."""
    board = Chessboard(7, 12, 0.002).points
    noise = {"pixel_noise": 0.3, "translation_noise": 1e-4, "rotation_noise": 2e-4}
    scene = random_scene(3, 8, board, **noise)
    pixels = np.array(scene.data.pixels)
    patch = np.array([row * 12 + column for row in range(4) for column in range(3)])
    hidden = np.setdiff1d(np.arange(84), patch)
    pixels[FEW, hidden] = np.nan
    robot = SE3(np.asarray(scene.data.base_from_tool.wxyz_xyz))
    return Dataset.from_arrays(scene.data.points, pixels, robot, scene.data.image_size)


def test_a_view_with_twelve_good_corners_is_kept(few_corners):
    fit = fit_staged(few_corners)
    assert np.asarray(few_corners.visible)[FEW].sum() == 12
    assert whole(fit) == []
    assert np.asarray(fit.inliers)[FEW].sum() == 12
    # By its points alone it has the other of its two poses, 23 degrees off: motion knows.
    assert FEW in fit.views
    assert misfits(fit, few_corners)[FEW, 1] < np.deg2rad(5.0)


def misfits(fit, data):
    """What each view's pose is off the chain by, m and rad."""
    chain = fit.calibration.camera_from_world(data.base_from_tool)
    twists = np.asarray((chain.inverse() @ fit.step2.camera_from_world).log())
    return np.linalg.norm(twists.reshape(-1, 2, 3), axis=2)
