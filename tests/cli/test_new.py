"""A folder that was begun can be filled in and read, for every robot and every target."""

import shutil

import cv2
import numpy as np
import pytest
from text_files import unwrapped
from typer.testing import CliRunner

from smartview_jax.cli import app
from smartview_jax.files import read_yaml
from smartview_jax.geometry import ANGLE_UNITS, LENGTH_UNITS, host_matrices, pose_codec
from smartview_jax.io import load_dataset, load_rig, sample_folder
from smartview_jax.io.new_dataset import ROBOTS, TARGETS, write_new_dataset
from smartview_jax.io.poses import read_poses
from smartview_jax.schemas.dataset import DATASET_SCHEMA
from smartview_jax.schemas.validation import validate_content
from smartview_jax.simulation import paper_viewpoints
from smartview_jax.targets import target_from_dict


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("target", TARGETS)
def test_what_is_written_is_a_description(tmp_path, robot, target):
    path = write_new_dataset(tmp_path, robot, target, "eye_in_hand", (640, 480))
    content = read_yaml(path)
    validate_content(content, DATASET_SCHEMA)
    assert content["camera"]["image_size"] == [640, 480]
    assert len(target_from_dict(content["target"]).points) > 10


@pytest.mark.parametrize("robot", ROBOTS)
def test_rows_of_the_robot_are_read_as_its_poses(tmp_path, robot):
    content = read_yaml(write_new_dataset(tmp_path, robot, "charuco", "eye_to_hand", (640, 480)))
    entry, codec, poses = (
        content["poses"],
        pose_codec(ROBOTS[robot].codec),
        paper_viewpoints(np.random.default_rng(0)),
    )
    rows = np.asarray(codec.encode(poses), dtype=float)
    rows[:, list(codec.length_columns)] /= LENGTH_UNITS[entry["length_unit"]]
    rows[:, list(codec.angle_columns)] /= ANGLE_UNITS[entry["angle_unit"]]
    with open(tmp_path / "poses.csv", "a") as table:
        for view, row in enumerate(rows):
            table.write(",".join([str(view), *map(repr, row.tolist())]) + "\n")
    view_ids, found, masked, *_ = read_poses(tmp_path, entry, "raise")
    assert len(view_ids) == len(rows)
    assert not masked
    np.testing.assert_allclose(host_matrices(found), host_matrices(poses), atol=1e-9)


def test_the_command_says_what_to_do_next_and_overwrites_nothing(tmp_path):
    words = ["new", str(tmp_path / "mine"), "--robot", "fanuc", "--target", "chessboard"]
    run = CliRunner().invoke(app, words)
    assert run.exit_code == 0
    assert f"smartview check {tmp_path / 'mine'}" in run.output
    assert (tmp_path / "mine" / "poses.csv").read_text().startswith("view,x,y,z,W,P,R")
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "exists already" in again.output


def test_an_unknown_robot_is_named_with_the_known_ones(tmp_path):
    run = CliRunner().invoke(app, ["new", str(tmp_path / "mine"), "--robot", "kukka"])
    assert run.exit_code == 2
    assert "kuka" in run.output
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".PNG"])
def test_pictures_that_are_there_already_are_described(tmp_path, suffix):
    """Their size, suffix and number need not be stated by a person."""
    images = tmp_path / "mine" / "images"
    images.mkdir(parents=True)
    for name in (f"a{suffix}", f"b{suffix}", "screen.bmp"):
        (images / name).write_bytes(cv2.imencode(suffix.lower(), np.zeros((48, 64), np.uint8))[1])
    (images / "Thumbs.db").write_bytes(b"no picture")
    run = CliRunner().invoke(app, ["new", str(tmp_path / "mine")])
    assert run.exit_code == 0
    assert f"2 pictures named *{suffix}, 64 x 48 px" in unwrapped(run.output)
    assert "other files: screen.bmp" in unwrapped(run.output)
    content = read_yaml(tmp_path / "mine" / "dataset.yaml")
    assert content["camera"]["image_size"] == [64, 48]
    assert content["pictures"]["pattern"] == "images/{view}" + suffix


def test_a_grid_of_tags_is_not_begun_with_the_numbers_of_kalibr(tmp_path):
    for kind in ("tag_grid", "aprilgrid"):
        write_new_dataset(tmp_path / kind, "ros", kind, "eye_in_hand", (640, 480))
    tags, april = (
        target_from_dict(read_yaml(tmp_path / kind / "dataset.yaml")["target"])
        for kind in ("tag_grid", "aprilgrid")
    )
    assert (april.rows, april.columns, april.size, april.border_bits) == (6, 6, 0.088, 2)
    assert tags.size != april.size
    assert tags.border_bits == 1


def test_several_cameras_have_a_folder_each(tmp_path):
    picture = np.zeros((48, 64), dtype=np.uint8)
    (tmp_path / "images/left").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "images/left/a.jpg"), picture)
    told = CliRunner().invoke(app, ["new", str(tmp_path), "--cameras", "left, wrist"])
    assert told.exit_code == 0, told.output
    content = read_yaml(tmp_path / "dataset.yaml")
    assert content["cameras"] == {
        "left": {"image_size": [64, 48]},
        "wrist": {"image_size": [1280, 1024]},
    }
    assert content["pictures"] == {"pattern": "images/{camera}/{view}.jpg"}
    assert (tmp_path / "images/wrist").is_dir()
    told = CliRunner().invoke(app, ["new", str(tmp_path / "b"), "--cameras", "left,,right"])
    assert told.exit_code == 2
    assert "--cameras: expected different names between commas" in " ".join(told.stderr.split())
    told = CliRunner().invoke(app, ["new", str(tmp_path / "b"), "--cameras", "left,../x"])
    assert told.exit_code == 2
    assert not (tmp_path / "b").exists()


def test_a_camera_on_one_hand_that_sees_the_other_is_begun(tmp_path):
    words = ["new", str(tmp_path / "cell"), "--cameras", "wrist,fixed", "--eye-to-hand"]
    for wrong in ("a+,b", "a+wrist,b", "a+b"):
        told = CliRunner().invoke(app, [*words, "--arms", wrong])
        assert told.exit_code == 2
        assert "--arms: expected an arm for each camera" in " ".join(told.stderr.split())
    told = CliRunner().invoke(app, [*words, "--arms", "a+b,b"])
    assert told.exit_code == 0, told.output
    cameras = read_yaml(tmp_path / "cell/dataset.yaml")["cameras"]
    assert [cameras["wrist"].get(name) for name in ("arm", "target_arm")] == ["a", "b"]
    assert [cameras["fixed"].get(name) for name in ("arm", "target_arm")] == ["b", None]
    assert {path.parent.name for path in tmp_path.glob("cell/*/poses.csv")} == {"a", "b"}


def test_several_arms_can_be_filled_in_and_read(tmp_path):
    """With the sample's pictures and poses, which both arms are said to have."""
    sample, folder = sample_folder(), tmp_path / "cell"
    views = {"left": ("0", "1"), "right": ("2", "3", "4")}
    for camera, names in views.items():
        (folder / "images" / camera).mkdir(parents=True)
        for name in names:
            shutil.copy(sample / f"images/{name}.png", folder / "images" / camera)
    words = ["--robot", "ros", "--target", "circle_grid", "--cameras", "left,right"]
    told = CliRunner().invoke(app, ["new", str(folder), *words, "--arms", "a,b"])
    assert told.exit_code == 0, told.output
    head, *rows = (sample / "poses.csv").read_text().splitlines()
    for arm, names in zip("ab", views.values(), strict=True):
        table = folder / arm / "poses.csv"
        assert table.read_text() == f"{head}\n"
        with open(table, "a") as file:
            file.writelines(f"{row}\n" for row in rows if row.split(",")[0] in names)
    rig = load_rig(folder)
    assert rig.arms == {"left": "a", "right": "b"}
    assert rig.view_ids == ("a/0", "a/1", "b/2", "b/3", "b/4")
    assert rig.usable_views().tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(
        host_matrices(rig.base_from_tool),
        host_matrices(load_dataset(sample).select(range(5)).base_from_tool),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--arms", "a,b"], "an arm for each camera of --cameras"),
        (["--cameras", "left,right", "--arms", "a"], "found 'a' for left,right"),
        (["--cameras", "left,right", "--arms", "left,b"], "names that no camera has"),
        (["--cameras", "l,r", "--arms", "a,b", "--eye-to-hand"], "see no target in common"),
        (["--cameras", "l,r", "--arms", "a,../b"], "arms"),
    ],
)
def test_arms_that_cannot_be_are_refused(tmp_path, words, message):
    told = CliRunner().invoke(app, ["new", str(tmp_path / "b"), *words])
    assert told.exit_code == 2
    assert message in " ".join(told.stderr.split())
    assert not (tmp_path / "b").exists()
