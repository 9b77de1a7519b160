"""Commands in every pose format fit on a terminal of 80 columns, with names of views."""

from types import SimpleNamespace

import numpy as np
import pytest

from smartview_jax.cli.robot_commands import print_viewpoints
from smartview_jax.geometry import POSE_CODECS, host_exponentials, host_transforms

NAMES = ("before_grasp", "after")
MOVED = host_transforms(
    host_exponentials(
        np.array([[-0.612345, 0.1, -0.9, 0.1, -0.2, 3.0], [0.2, 0.3, 1.0, 0.3, 2.0, 0.1]])
    )
)


@pytest.mark.parametrize("codec", POSE_CODECS.values(), ids=lambda codec: codec.name)
def test_no_number_of_a_command_is_cut(codec, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    print_viewpoints(NAMES, SimpleNamespace(base_from_tool=MOVED), codec)
    printed = capsys.readouterr().out
    assert "…" not in printed
    assert max(len(line.rstrip()) for line in printed.splitlines()) <= 80
    numbers = [
        float(word)
        for line in printed.partition("─")[2].splitlines()[1:]
        for word in line.split()
        if word not in NAMES
    ]
    expected = np.asarray(codec.encode(MOVED, *codec.units)).ravel()
    np.testing.assert_allclose(numbers, expected, atol=6e-4)
