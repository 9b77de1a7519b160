"""Poses with too few digits are told so; those with enough are not."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import as_se3
from smartview_jax.io.poses import poses_entry, read_poses, write_poses


def notes_of(folder, pose_format, decimals):
    """The notes on a table with so many decimals of its positions and of its rotations."""
    rng = np.random.default_rng(0)
    matrices = np.tile(np.eye(4), (10, 1, 1))
    matrices[:, :3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.5, (10, 3))).as_matrix()
    matrices[:, :3, 3] = rng.uniform(0.2, 0.8, (10, 3))
    write_poses(folder, [str(k) for k in range(10)], as_se3(matrices), pose_format)
    header, *rows = (folder / "poses.csv").read_text().splitlines()
    digits = [decimals[0]] * 3 + [decimals[1]] * 4
    rounded = [
        ",".join((view, *(f"{float(x):.{d}f}" for x, d in zip(numbers, digits, strict=False))))
        for view, *numbers in (row.split(",") for row in rows)
    ]
    (folder / "poses.csv").write_text("\n".join([header, *rounded]) + "\n")
    return read_poses(folder, poses_entry(10, pose_format), "mask").table.notes


@pytest.mark.parametrize(
    ("pose_format", "decimals", "words"),
    [
        ("fanuc_wpr", (0, 3), "positions to 1 mm:"),
        ("fanuc_wpr", (2, 0), "rotations to 1 degrees:"),
        ("fanuc_wpr", (0, 1), "positions to 1 mm and rotations to 0.1 degrees:"),
        ("ur", (3, 5), "positions to 1 mm:"),
        ("quaternion_xyzw", (5, 3), "rotations to 0.11 degrees:"),
    ],
)
def test_rounded_poses_are_told_so(tmp_path, pose_format, decimals, words):
    (note,) = notes_of(tmp_path, pose_format, decimals)
    assert note.startswith(f"poses.csv has {words}")


@pytest.mark.parametrize(
    ("pose_format", "decimals"),
    [("fanuc_wpr", (1, 2)), ("ur", (4, 4)), ("quaternion_xyzw", (4, 4))],
)
def test_enough_digits_are_not_spoken_of(tmp_path, pose_format, decimals):
    assert notes_of(tmp_path, pose_format, decimals) == ()
