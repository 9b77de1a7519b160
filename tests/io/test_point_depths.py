"""Depths at the points of a folder: written, read again, and what is wrong is named."""

import numpy as np
import pytest
import yaml

import smartview_jax as sv
from smartview_jax.dataset import DepthNoise
from smartview_jax.io import save_dataset
from smartview_jax.simulation import random_target_scene
from smartview_jax.targets import Chessboard

NOISE = DepthNoise(2e-4, 2e-3)


@pytest.fixture
def folder(tmp_path):
    """A folder with a table of depths."""
    scene = random_target_scene(0, 4, Chessboard(3, 4, 0.01))
    rng = np.random.default_rng(0)
    depths = 0.2 + 2e-4 * rng.normal(size=scene.data.visible.shape)
    depths[1, 2] = np.nan
    data = scene.data.with_depths(depths, NOISE)
    save_dataset(data, tmp_path / "board")
    return tmp_path / "board", data


def test_depths_are_read_as_they_were_written(folder):
    path, data = folder
    again = sv.load_dataset(path)
    assert again.depth_noise == NOISE
    np.testing.assert_array_equal(again.depths.used, data.depths.used)
    np.testing.assert_allclose(again.depths.measured, data.depths.measured, rtol=1e-12)
    np.testing.assert_allclose(again.depths.precision, data.depths.precision, rtol=1e-12)
    assert not again.depths.used[1, 2]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\n0,0,", "\nabsent,0,", "view 'absent' has no pose"),
        ("\n0,1,", "\n0,0,", "view 0: point 0 has more than one row"),
        ("\n0,0,", "\n0,99,", "view 0: the target has no point 99"),
        ("\n0,0,0.", "\n0,0,-0.", "view 0, point 0: expected above 0 m"),
        ("depth_m", "depth_mm", "missing depth_m"),
    ],
)
def test_wrong_tables_are_named(folder, old, new, message):
    path, _ = folder
    table = path / "depths.csv"
    text = table.read_text()
    assert old in text
    table.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        sv.load_dataset(path)


def test_wrong_descriptions_are_named(folder):
    path, _ = folder
    description = path / "dataset.yaml"
    content = yaml.safe_load(description.read_text())
    content["depths"]["rows"] += 1
    description.write_text(yaml.safe_dump(content, sort_keys=False))
    with pytest.raises(ValueError, match="truncated"):
        sv.load_dataset(path)
    del content["depths"]["rows"]
    content["depths"]["noise"] = {"constant": 0.0}
    description.write_text(yaml.safe_dump(content, sort_keys=False))
    with pytest.raises(ValueError, match=r"dataset\.yaml: DepthNoise: expected numbers"):
        sv.load_dataset(path)
