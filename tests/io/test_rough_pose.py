import re
import shutil

import numpy as np
import pytest
import yaml
from detected_sample import detected_sample
from typer.testing import CliRunner

from smartview_jax.cli import app
from smartview_jax.io import load_dataset, parse_rough_pose, sample_folder
from smartview_jax.io.folder_description import rough_pose
from smartview_jax.schemas.dataset import DATASET_SCHEMA, DatasetFile
from smartview_jax.schemas.validation import validate_content
from smartview_jax.targets import CircleGrid

ROUGH = {"translation": [0.4, 0.0, 0.1], "yaw_pitch_roll_deg": [90.0, 0.0, 180.0]}
"""x along the base's y, z down: into a board that lies on a table."""


def described(entries: dict[str, object]) -> DatasetFile:
    """A description with these entries, as it is read from a file."""
    whole = yaml.safe_load((sample_folder() / "dataset.yaml").read_text())
    return validate_content({**whole, **entries}, DATASET_SCHEMA)


@pytest.fixture(scope="module")
def plain_sample(tmp_path_factory):
    """The package's sample as if its grid had no mark, with its detections kept."""
    folder = tmp_path_factory.mktemp("plain")
    shutil.copytree(sample_folder(), folder, dirs_exist_ok=True)
    text = (folder / "dataset.yaml").read_text().replace(", origin_mark: true", "")
    (folder / "dataset.yaml").write_text(text)
    load_dataset(folder)
    return folder


def test_a_plain_grid_is_turned_as_the_folder_or_the_caller_says(plain_sample):
    """The mark of the real grid says how it stands: x along the base's x, z down."""
    truth = np.asarray(detected_sample().pixels)
    quarter = CircleGrid(10, 10, 0.0254).symmetries
    messages = []
    data = load_dataset(plain_sample, progress=messages.append)
    np.testing.assert_allclose(data.pixels, truth, atol=0.1)
    (note,) = data.notes
    assert note in messages
    assert "looks the same in 4 orders" in note
    assert data.select([0, 1]).notes == data.notes

    rough = parse_rough_pose("--base-from-world", "0.4,0,0.1,90,0,180")
    turned = load_dataset(plain_sample, holder_from_world=rough)
    assert "nearest to the rough base_from_world" in turned.notes[0]
    (k,) = [k for k in range(4) if np.allclose(turned.pixels, truth[:, quarter[k]], atol=0.1)]
    assert k in (1, 3)

    path = plain_sample / "dataset.yaml"
    kept = path.read_text()
    path.write_text(f"{kept}\nbase_from_world: {ROUGH}\n")
    np.testing.assert_array_equal(load_dataset(plain_sample).pixels, turned.pixels)
    path.write_text(f"{kept}\ntool_from_world: {ROUGH}\n")
    with pytest.raises(
        ValueError, match=r"dataset\.yaml: tool_from_world: .*: give base_from_world"
    ):
        load_dataset(plain_sample)
    path.write_text(kept)


def test_six_numbers_are_metres_and_degrees():
    pose = parse_rough_pose("--base-from-world", "0.4,0,0.1,90,0,180")
    np.testing.assert_allclose(pose.translation(), [0.4, 0.0, 0.1])
    np.testing.assert_allclose(
        pose.rotation().as_matrix(), [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12
    )
    quaternion = {"translation": [0.4, 0.0, 0.1], "quaternion_wxyz": [0.0, 0.5**0.5, 0.5**0.5, 0.0]}
    for entry in (ROUGH, quaternion):
        read = rough_pose(described({"base_from_world": entry}).base_from_world)
        assert read is not None
        np.testing.assert_allclose(read.as_matrix(), pose.as_matrix(), atol=1e-9)
    held = described({"mount": "eye_to_hand", "tool_from_world": ROUGH})
    held = rough_pose(held.tool_from_world)
    assert held is not None
    np.testing.assert_allclose(held.as_matrix(), pose.as_matrix(), atol=1e-12)
    assert rough_pose(described({"mount": "eye_to_hand"}).tool_from_world) is None


@pytest.mark.parametrize(
    "entry",
    [
        [1, 2, 3],
        {"translation": [0, 0, 0]},
        {**ROUGH, "quaternion_wxyz": [1, 0, 0, 0]},
        {"translation": [0, 0], "yaw_pitch_roll_deg": [0, 0, 0]},
        {"translation": 1, "yaw_pitch_roll_deg": [0, 0, 0]},
        {"translation": [0, 0, float("nan")], "yaw_pitch_roll_deg": [0, 0, 0]},
        {"translation": [400, 0, 100], "yaw_pitch_roll_deg": [0, 0, 0]},
        {"translation": [0, 0, 0], "yaw_pitch_roll_deg": [0, 0, 1e6]},
        {"translation": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 1]},
    ],
)
def test_what_is_no_pose_is_named(entry):
    with pytest.raises(ValueError, match=r"base_from_world(: |\.)"):
        described({"base_from_world": entry})


@pytest.mark.parametrize(
    ("mount", "wrong", "right"),
    [
        ("eye_in_hand", "tool_from_world", "base_from_world"),
        ("eye_to_hand", "base_from_world", "tool_from_world"),
    ],
)
def test_the_pose_of_the_other_mounts_target_is_named(mount, wrong, right):
    with pytest.raises(ValueError, match=f"{wrong}: .*: give {right}"):
        described({"mount": mount, wrong: ROUGH})


@pytest.mark.parametrize("words", ["1,2,3", "a,b,c,d,e,f", "0,0,0,0,0,inf"])
def test_an_option_that_is_no_pose_is_named(words):
    run = CliRunner().invoke(app, ["calibrate", "--base-from-world", words])
    assert run.exit_code == 2
    assert re.search(r"--base-from-world: expected six\s+numbers", run.stderr)
    assert words in run.stderr
