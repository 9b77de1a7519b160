import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.cli.load import load_views
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.io import load_object_views, write_object_views
from smartview_jax.robots import Command, six_axes
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.simulation import paper_calibration

# As a file of matrices gives them, to the last bit.
POSES = as_se3(host_matrices(paper_calibration().command_for(sv.five_viewpoints(np.zeros(3), 0.2))))
PICTURES = [np.random.default_rng(k).integers(0, 255, (12, 16), np.uint8) for k in range(5)]
NAMES = ["above", "left", "right", "front", "back"]


@pytest.fixture
def folder(tmp_path):
    return write_object_views(tmp_path / "object", NAMES, PICTURES, POSES)


def test_a_folder_without_a_description_is_named(tmp_path):
    """Without the hint at `smartview new`, which begins data sets alone."""
    with pytest.raises(FileNotFoundError, match=r"\.yaml: no such file$"):
        load_object_views(tmp_path)


def test_what_is_written_is_read(folder):
    views = load_object_views(folder)
    assert views.view_ids == tuple(NAMES)
    assert views.image_size == (16, 12)
    for written, read in zip(PICTURES, views.pictures, strict=True):
        np.testing.assert_array_equal(read, written)
    np.testing.assert_allclose(
        host_matrices(views.base_from_tool), host_matrices(POSES), rtol=0.0, atol=1e-15
    )


def test_what_was_recognised_in_the_table_is_said(folder, capsys):
    path = folder / "poses.csv"
    path.write_text(path.read_text().replace(",", ";"))
    seen = ("poses.csv was read separated by semicolons",)
    assert load_object_views(folder).notes == seen
    names = load_views(folder).names
    assert names == NAMES
    assert capsys.readouterr().err.splitlines() == list(seen)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[16,", "[17,", r"above.png: expected 17 x 12 px, found 16 x 12"),
        ("rows: 5", "rows: 6", "poses.csv: .*6"),
        ("pictures:", "picture:", r"object_views.yaml: .*'picture'.*pictures"),
        ("end: smartview_object_views", "", r"object_views.yaml: entry 'end' is missing"),
    ],
)
def test_a_wrong_description_is_named(folder, old, new, message):
    path = folder / "object_views.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        load_object_views(folder)


def test_a_missing_picture_is_named(folder):
    (folder / "images/left.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"left\.png"):
        load_object_views(folder)


def test_only_pictures_that_fit_together_are_written(tmp_path):
    with pytest.raises(ValueError, match="5 views, 4 pictures and 5 poses"):
        write_object_views(tmp_path, NAMES, PICTURES[:4], POSES)
    with pytest.raises(ValueError, match="expected one size"):
        write_object_views(tmp_path, NAMES, [*PICTURES[:4], PICTURES[0].T.copy()], POSES)
    joints = np.zeros((5, 6))
    with pytest.raises(ValueError, match="joint readings of the command, and arm: give both"):
        write_object_views(tmp_path, NAMES, PICTURES, six_axes().command(joints))
    fewer = Command(as_se3(POSES), to_device(joints[:4]))
    with pytest.raises(ValueError, match="joints: expected 5 rows, found 4"):
        write_object_views(tmp_path, NAMES, PICTURES, fewer, arm=six_axes())
    assert not list(tmp_path.iterdir())


def test_joint_readings_are_written_and_read(tmp_path):
    arm, joints = six_axes(), np.random.default_rng(0).uniform(-1.0, 1.0, (5, 6))
    poses = arm.base_from_tool(joints)
    folder = write_object_views(tmp_path, NAMES, PICTURES, arm.command(joints), arm=arm)
    views = load_object_views(folder)
    np.testing.assert_allclose(views.command.joints, joints, rtol=1e-14)
    # Without a table of poses they are the arm's own.
    description = folder / "object_views.yaml"
    lines = description.read_text().splitlines(keepends=True)
    start = next(k for k, line in enumerate(lines) if line.startswith("poses:"))
    end = next(k for k in range(start + 1, len(lines)) if not lines[k].startswith(" "))
    description.write_text("".join(lines[:start] + lines[end:]))
    loaded = host_matrices(load_object_views(folder).base_from_tool)
    np.testing.assert_allclose(loaded, host_matrices(poses), atol=1e-12)
    description.write_text("".join(lines[:start] + lines[end:]).replace("joints:", "reading:", 1))
    with pytest.raises(ValueError, match=r"object_views.yaml: .*'reading'"):
        load_object_views(folder)
