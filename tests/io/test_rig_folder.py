"""A folder with several cameras that watched one robot."""

import dataclasses
import shutil

import cv2
import numpy as np
import pytest
from detected_sample import detected_sample
from fit_scenes import scene_of
from jaxlie import SE3
from text_files import edit

from smartview_jax import Rig, load_dataset, load_rig, save_rig
from smartview_jax.dataset import DepthNoise
from smartview_jax.geometry import host_matrices
from smartview_jax.io import is_rig_folder, sample_folder
from smartview_jax.robots import six_axes
from smartview_jax.simulation import paper_calibration, simulate
from smartview_jax.targets import Chessboard, ListedPoints

TARGET = Chessboard(rows=4, columns=3, square=0.05)


def seen(views, target, mount="eye_in_hand"):
    """Views of a target from poses of a scene."""
    poses = scene_of(0).data.base_from_tool
    data = simulate(paper_calibration(), SE3(poses.wxyz_xyz[views]), target.points, 0, 0.1).data
    names = tuple(f"state {k}" for k in range(views.start, views.stop))
    return dataclasses.replace(data, view_ids=names, target=target, mount=mount)


@pytest.fixture(scope="module")
def rig():
    """A camera on the hand and one next to the arm, which see one state of the robot together."""
    first = seen(slice(0, 4), TARGET)
    second = seen(slice(3, 7), dataclasses.replace(TARGET, square=0.03), "eye_to_hand")
    return Rig({"wrist": first, "fixed": second}, {"wrist": "table", "fixed": "hand"})


def test_what_was_saved_is_loaded(rig, tmp_path):
    save_rig(rig, tmp_path, "quaternion_xyzw")
    assert is_rig_folder(tmp_path)
    loaded = load_rig(tmp_path)
    assert loaded.targets == rig.targets
    assert loaded.view_ids == rig.view_ids
    for name, data in rig.cameras.items():
        actual = loaded.cameras[name]
        assert (actual.mount, actual.view_ids) == (data.mount, data.view_ids)
        assert actual.target == data.target
        np.testing.assert_array_equal(actual.visible, data.visible)
        np.testing.assert_allclose(actual.pixels, data.pixels, atol=1e-9)


def test_one_mount_and_target_are_written_once(rig, tmp_path):
    wrist = rig.cameras["wrist"]
    save_rig(Rig({"left": wrist, "right": wrist}), tmp_path)
    text = (tmp_path / "dataset.yaml").read_text()
    assert text.count("chessboard") == 1
    assert text.count("mount") == 1
    assert load_rig(tmp_path).targets == {"left": "target", "right": "target"}


@pytest.fixture(scope="module")
def pictured(tmp_path_factory):
    """Pictures of two cameras, of three states of the robot."""
    folder = tmp_path_factory.mktemp("pictured")
    views = {"left": "01", "right": "12"}
    for camera, names in views.items():
        (folder / "images" / camera).mkdir(parents=True)
        for name in names:
            shutil.copy(sample_folder() / f"images/{name}.png", folder / f"images/{camera}")
    rows = (sample_folder() / "poses.csv").read_text().splitlines()[:4]
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    text = (sample_folder() / "dataset.yaml").read_text()
    size = ", ".join(map(str, detected_sample().image_size))
    lines = [line for line in text.splitlines() if not line.startswith(("camera", "pictures"))]
    cameras = [f"  {camera}: {{image_size: [{size}]}}" for camera in views]
    pattern = 'pictures: {pattern: "images/{camera}/{view}.png"}'
    description = [lines[0], "cameras:", *cameras, pattern, *lines[1:]]
    (folder / "dataset.yaml").write_text("\n".join(description) + "\n")
    return folder


def test_a_camera_has_the_states_of_which_it_has_pictures(pictured):
    loaded, alone = load_rig(pictured), detected_sample()
    assert loaded.cameras["left"].view_ids == ("0", "1")
    assert loaded.cameras["right"].view_ids == ("1", "2")
    for name, views in (("left", [0, 1]), ("right", [1, 2])):
        np.testing.assert_array_equal(loaded.cameras[name].pixels, np.asarray(alone.pixels)[views])
        assert (pictured / f"detections/{name}.csv").is_file()
    messages = []
    load_rig(pictured, progress=messages.append)
    assert messages == [
        f"{name}: detections of 2 views from {name}.csv" for name in ("left", "right")
    ]


def test_depths_of_a_camera_are_written_and_read(rig, tmp_path):
    wrist = rig.cameras["wrist"]
    depths = 0.2 + 2e-4 * np.random.default_rng(0).normal(size=wrist.visible.shape)
    depths[1, 2] = np.nan
    noise = DepthNoise(2e-4, 2e-3)
    with_depths = {**rig.cameras, "wrist": wrist.with_depths(depths, noise)}
    save_rig(rig.with_cameras(with_depths), tmp_path)
    loaded = load_rig(tmp_path).cameras
    assert loaded["fixed"].depths is None
    assert loaded["wrist"].depth_noise == noise
    used = np.isfinite(depths) & np.asarray(wrist.visible)
    np.testing.assert_array_equal(loaded["wrist"].depths.used, used)
    np.testing.assert_allclose(loaded["wrist"].depths.measured[used], depths[used], rtol=1e-12)
    edit(tmp_path / "depths/wrist.csv", "0,0,", "0,99,")
    with pytest.raises(ValueError, match=r"wrist\.csv: view state 0: the target has no point 99"):
        load_rig(tmp_path)


def test_depth_pictures_of_a_camera_are_read(pictured, tmp_path):
    folder = tmp_path / "rig"
    shutil.copytree(pictured, folder)
    entry = 'depth_pictures: {pattern: "depth/{view}.png", unit: mm, noise: {constant: 0.001}}'
    edit(folder / "dataset.yaml", "left: {", f"left: {{{entry}, ")
    with pytest.raises(FileNotFoundError, match=r"depth/0\.png"):
        load_rig(folder)
    (folder / "depth").mkdir()
    width, height = detected_sample().image_size
    for view in "01":
        cv2.imwrite(str(folder / f"depth/{view}.png"), np.full((height, width), 431, np.uint16))
    data = load_rig(folder).cameras["left"]
    seen = np.asarray(data.visible)
    np.testing.assert_array_equal(data.depths.used, seen)
    np.testing.assert_allclose(np.asarray(data.depths.measured)[seen], 0.431)
    edit(folder / "dataset.yaml", "unit: mm, noise: {constant: 0.001}", "unit: mm, camera: c.yaml")
    with pytest.raises(ValueError, match=r"cameras\.left.*depth_pictures\.camera: leave it out"):
        load_rig(folder)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "images/left/0.png").unlink(), r"view 0: no camera has a picture of it"),
        (lambda f: shutil.rmtree(f / "images/right"), "camera right has no picture"),
        (
            lambda f: edit(f / "dataset.yaml", "{camera}/", ""),
            r"pictures.pattern: expected a name with \{camera\} and \{view\}",
        ),
        (
            lambda f: edit(f / "dataset.yaml", "right: {", "right: {target: table, "),
            "cameras.right.target: there is one 'target' for all cameras",
        ),
        (
            lambda f: edit(f / "dataset.yaml", "right: {", "right: {mount: ceiling, "),
            "cameras.right.mount is one of eye_in_hand, eye_to_hand, hand_to_hand; found 'ceiling'",
        ),
        (
            lambda f: shutil.copy(f / "images/left/0.png", f / "images/left/7.png"),
            "no pose for the picture 7.png",
        ),
    ],
)
def test_mistakes_are_named(pictured, tmp_path, spoil, message):
    folder = tmp_path / "spoilt"
    shutil.copytree(pictured, folder)
    spoil(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_rig(folder)


def test_each_kind_of_folder_names_its_reader(pictured):
    with pytest.raises(ValueError, match="a folder with several cameras is read by load_rig"):
        load_dataset(pictured)
    with pytest.raises(ValueError, match="entry 'cameras' is missing: load_dataset reads one"):
        load_rig(sample_folder())
    assert not is_rig_folder(sample_folder())


@pytest.mark.parametrize("without", [("left",), ("right",), ("left", "right")])
def test_points_without_a_target_are_listed_unless_another_camera_has_the_target(
    rig, tmp_path, without
):
    wrist = rig.cameras["wrist"]
    bare = dataclasses.replace(wrist, target=None)
    cameras = {name: bare if name in without else wrist for name in ("left", "right")}
    save_rig(Rig(cameras), tmp_path / "saved")
    again = load_rig(tmp_path / "saved")
    kind = ListedPoints if len(without) == 2 else type(wrist.target)
    for data in again.cameras.values():
        assert type(data.target) is kind
        np.testing.assert_array_equal(data.points, wrist.points)


def test_a_camera_with_another_target_is_not_written(rig, tmp_path):
    wrist = rig.cameras["wrist"]
    other = seen(slice(0, 4), dataclasses.replace(TARGET, rows=3, columns=4))
    with pytest.raises(ValueError, match="camera 'right' describes 'target' otherwise"):
        save_rig(Rig({"left": wrist, "right": other}), tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.fixture(scope="module")
def arms_folder(tmp_path_factory):
    """Two arms that see one table; the states of both have the same names."""
    left = seen(slice(0, 4), TARGET)
    joints = np.linspace(-1.0, 1.0, 24).reshape(4, 6)
    right = dataclasses.replace(
        seen(slice(3, 7), TARGET),
        base_from_tool=six_axes().base_from_tool(joints),
        view_ids=left.view_ids,
    ).with_joints(joints, six_axes())
    rig = Rig({"l": left, "r": right}, arms={"l": "left", "r": "right"})
    folder = tmp_path_factory.mktemp("arms")
    save_rig(rig, folder)
    return rig, folder


def test_every_arm_has_its_own_tables(arms_folder):
    rig, folder = arms_folder
    assert (folder / "left/poses.csv").is_file()
    assert (folder / "right/joints.csv").is_file()
    loaded = load_rig(folder)
    assert loaded.arms == rig.arms
    assert loaded.targets == rig.targets
    assert loaded.view_ids == rig.view_ids
    np.testing.assert_allclose(
        host_matrices(loaded.base_from_tool), host_matrices(rig.base_from_tool), atol=1e-12
    )
    np.testing.assert_allclose(
        loaded.of_arm("right").joints, rig.of_arm("right").joints, atol=1e-12
    )
    assert loaded.of_arm("left").joints is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("arm: right", "arm: up", "cameras.r.arm: expected one of left, right, found 'up'"),
        ("arm: right", "arm: left", "arms.right: no camera names this arm"),
        ("file: right/poses.csv", "file: none.csv", "none.csv"),
        (
            "arms:",
            "base_from_world: {translation: [0, 0, 1], quaternion_wxyz: [1, 0, 0, 0]}\narms:",
            "base_from_world: with several arms it is an entry of each of the 'arms'",
        ),
        ("right:\n    poses:", "right:\n    poses_of_arm:", "arms.right"),
    ],
)
def test_mistakes_in_arms_are_named(arms_folder, tmp_path, old, new, message):
    folder = tmp_path / "spoilt"
    shutil.copytree(arms_folder[1], folder)
    edit(folder / "dataset.yaml", old, new)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_rig(folder)


def test_an_arm_without_arms_is_named(pictured, tmp_path):
    folder = tmp_path / "spoilt"
    shutil.copytree(pictured, folder)
    edit(folder / "dataset.yaml", "right: {", "right: {arm: left, ")
    with pytest.raises(ValueError, match=r"cameras.right.arm: the file has no 'arms'"):
        load_rig(folder)
