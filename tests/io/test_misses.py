"""Measured misses are read with their unit, by name, or refused."""

import numpy as np
import pytest

from smartview_jax.io import read_misses

NAMES = ("v1", "v2")


def test_a_table_and_a_mapping_say_the_same(tmp_path):
    (tmp_path / "m.csv").write_text("view,x_mm,y_mm,z_mm\nv2,1,0,-3\nv1,0.5,-0.25,0\n")
    (tmp_path / "m.yaml").write_text("unit: mm\nmisses: {v1: [0.5, -0.25, 0], v2: [1, 0, -3]}\n")
    expected = 1e-3 * np.array([[0.5, -0.25, 0.0], [1.0, 0.0, -3.0]])
    for name in ("m.csv", "m.yaml"):
        np.testing.assert_allclose(read_misses(tmp_path / name, NAMES), expected)


def test_what_was_recognised_is_said(tmp_path):
    (tmp_path / "m.csv").write_text("view;x_mm;y_mm\nv1;0,5;-1,5\nv2;1,5;0,5\n")
    said = []
    loaded = read_misses(tmp_path / "m.csv", NAMES, said.append)
    np.testing.assert_allclose(loaded, 1e-3 * np.array([[0.5, -1.5], [1.5, 0.5]]))
    assert said == ["m.csv was read separated by semicolons; with a decimal comma"]


def test_height_need_not_be_measured(tmp_path):
    (tmp_path / "m.csv").write_text("view,x_m,y_m\nv1,0.001,0\nv2,0,0\n")
    assert read_misses(tmp_path / "m.csv", NAMES).shape == (2, 2)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.csv", "view,x,y\nv1,1,2\nv2,1,2\n", "columns view, x_mm, y_mm"),
        ("m.csv", "view,x_mm,y_mm\nv1,1,2\n", "missing or unknown: v2"),
        ("m.csv", "view,x_mm,y_mm\nv1,1,2\nv1,1,2\n", "v1 has more than one row"),
        ("m.csv", "view,x_m,y_m\nv1,1,2\nv2,0,0\n", "millimetres given as metres"),
        ("m.csv", "view,x_mm,y_mm\nv1,1,nan\nv2,0,0\n", "y_mm is nan"),
        ("m.yaml", "unit: mm\nmisses: {v1: [1], v2: [1, 2]}\n", "2 or 3 numbers"),
        ("m.yaml", "unit: mm\nmisses: {v1: [1, 2, 3], v2: [1, 2]}\n", "some have none"),
        ("m.yaml", "misses: {v1: [1, 2], v2: [1, 2]}\n", "unit"),
        ("m.txt", "", "ending in .csv, .yaml"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_misses(tmp_path / name, NAMES)
    assert name in str(caught.value)
