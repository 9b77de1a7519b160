"""A table of poses says its format in its header, or the description says it, or nobody does."""

import dataclasses

import numpy as np
import pytest

from smartview_jax import load_dataset, save_dataset
from smartview_jax.files import dump_yaml, read_yaml
from smartview_jax.geometry import POSE_CODECS, host_matrices
from smartview_jax.io import write_viewpoints
from smartview_jax.simulation import random_scene
from smartview_jax.targets import Chessboard

BOARD = Chessboard(9, 6, 0.004)
DATA = dataclasses.replace(random_scene(1, 4, BOARD.points).data, target=BOARD)


@pytest.fixture
def folder(tmp_path):
    save_dataset(DATA, tmp_path)
    return tmp_path


def with_poses(folder, **entry):
    """Describe the poses otherwise; nothing else of the description changes."""
    content = read_yaml(folder / "dataset.yaml")
    content["poses"] = entry
    (folder / "dataset.yaml").write_text(dump_yaml(content))
    return folder


def close(data):
    return np.allclose(host_matrices(data.base_from_tool), host_matrices(DATA.base_from_tool))


@pytest.mark.parametrize("pose_format", POSE_CODECS)
def test_a_data_set_is_written_in_every_format(tmp_path, pose_format):
    save_dataset(DATA, tmp_path, pose_format)
    assert close(load_dataset(tmp_path))


@pytest.mark.parametrize("ending", ["csv", "json"])
@pytest.mark.parametrize("pose_format", POSE_CODECS)
def test_a_file_of_viewpoints_needs_no_description(folder, ending, pose_format):
    name = f"views.{ending}"
    write_viewpoints(folder / name, DATA.base_from_tool, DATA.view_ids, pose_format=pose_format)
    assert close(load_dataset(with_poses(folder, file=name)))
    # To say the same once more does no harm.
    stated = with_poses(folder, file=name, codec=pose_format, direction="base_from_tool")
    assert close(load_dataset(stated))


@pytest.mark.parametrize("ending", ["csv", "json"])
@pytest.mark.parametrize(
    "entry", [{"codec": "ur"}, {"length_unit": "cm"}, {"direction": "tool_from_base"}]
)
def test_a_description_that_contradicts_the_file_is_refused(folder, ending, entry):
    name = f"views.{ending}"
    write_viewpoints(folder / name, DATA.base_from_tool, DATA.view_ids, pose_format="kuka_abc")
    ((key, value),) = entry.items()
    with pytest.raises(
        ValueError, match=rf"{name}: .*{key} is .* in the file but {value} in the description"
    ):
        load_dataset(with_poses(folder, file=name, **entry))


def test_units_in_a_header_of_ones_own(folder):
    """Centimetres and radians are nobody's format, but the header says so."""
    codec = POSE_CODECS["yaw_pitch_roll"]
    rows = np.array(codec.encode(DATA.base_from_tool, "cm", "rad"))
    lines = ["view,x_cm,y_cm,z_cm,yaw_rad,pitch_rad,roll_rad"]
    lines += [
        ",".join([view, *map(str, row)]) for view, row in zip(DATA.view_ids, rows, strict=True)
    ]
    (folder / "mine.csv").write_text("\n".join(lines))
    assert close(load_dataset(with_poses(folder, file="mine.csv")))
    inverse = load_dataset(with_poses(folder, file="mine.csv", direction="tool_from_base"))
    product = host_matrices(inverse.base_from_tool) @ host_matrices(DATA.base_from_tool)
    np.testing.assert_allclose(product, np.tile(np.eye(4), (4, 1, 1)), atol=1e-9)


def test_two_makers_angles_of_the_same_name_are_not_guessed(folder):
    """VAL's O, A, T and Kawasaki's are other rotations."""
    write_viewpoints(folder / "v.csv", DATA.base_from_tool, DATA.view_ids)
    text = (folder / "v.csv").read_text().replace("format,", "").replace("val_oat,", "")
    (folder / "v.csv").write_text(text)
    with pytest.raises(ValueError, match="fit val_oat and kawasaki_oat: add a column 'format'"):
        load_dataset(with_poses(folder, file="v.csv"))
    assert close(load_dataset(with_poses(folder, file="v.csv", codec="val_oat")))


def test_a_header_without_units_says_nothing(folder):
    with pytest.raises(
        ValueError, match=r"'poses\.codec' and .*poses\.csv does not state it; a tab"
    ):
        load_dataset(with_poses(folder, file="poses.csv"))
