"""The views of the board, and what is said when it is not there."""

import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.picking import calibrate_cell
from smartview_jax.picking.calibrating import DISTANCES, MAX_TILT, _planned_views, stacked_commands
from smartview_jax.robots import Command
from smartview_jax.simulation.cell import BOARD, drawn_calibration


class Blank:
    """A cell whose camera sees nothing."""

    def __init__(self):
        self.at = Command(drawn_calibration().command_for(np.eye(4)))

    def move(self, target):
        self.at = target
        return target

    def picture(self):
        return np.full((800, 1280), 90, np.uint8)

    def set_gripper(self, width):
        return width

    def where(self):
        return self.at


def test_a_board_that_is_not_found_is_said_with_the_number_of_views():
    with pytest.raises(ValueError, match="found in 0 of 7 views; expected 6 or more"):
        calibrate_cell(Blank(), BOARD, drawn_calibration(), views=7)


def test_planned_views_show_most_of_the_board_from_many_sides():
    drawing = drawn_calibration()
    views = _planned_views(BOARD, 24, 0, DISTANCES, MAX_TILT)
    points = BOARD.points @ views[:, :3, :3].swapaxes(1, 2) + views[:, None, :3, 3]
    pixels, valid = (np.asarray(x) for x in drawing.camera.project(jnp.asarray(points)))
    size = np.array(drawing.camera.image_size)
    inside = valid & (pixels > 0.0).all(axis=-1) & (pixels < size - 1.0).all(axis=-1)
    # Some views are near and cut the board; the detector needs all of it in enough of them.
    assert np.median(inside.mean(axis=1)) > 0.95
    tilts = np.arccos(-views[:, 2, 2])
    assert tilts.min() < np.deg2rad(14.0)
    assert tilts.max() > np.deg2rad(25.0)


def test_planned_views_keep_to_their_limits():
    views = _planned_views(BOARD, 24, 0, (1.0, 1.2), 0.1)
    centres = np.linalg.inv(views)[:, :3, 3]
    # Aimed beside the board's middle by a quarter of its size, along the axis of the camera.
    heights = np.abs(centres[:, 2])
    assert heights.min() > np.cos(0.1) - 1e-9
    assert heights.max() <= 1.2
    assert np.arccos(np.abs(views[:, 2, 2])).max() < 0.1


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"distances": (0.5, 0.4)}, "distances: .*found"),
        ({"distances": (-0.1, 0.4)}, "distances: .*found"),
        ({"max_tilt": 1.6}, "max_tilt: .*found 1.6"),
    ],
)
def test_views_that_cannot_be_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        calibrate_cell(Blank(), BOARD, drawn_calibration(), **given)


def test_commands_are_stacked_with_joints_only_if_all_have_them():
    one = Command(drawn_calibration().command_for(np.eye(4)))
    stacked = stacked_commands([one, one])
    assert host_matrices(stacked.base_from_tool).shape == (2, 4, 4)
    assert stacked.joints is None


def test_what_perspective_makes_of_the_circles_is_corrected(monkeypatch):
    """Against where the true calibration sees the centres; as found they are 0.1 px off."""
    pytest.importorskip("mujoco")
    from smartview_jax.simulation.cell import SimulatedCell

    cell, poses = SimulatedCell(0), []
    take = cell.picture

    def picture():
        poses.append(cell.judge_tool())
        return take()

    fitted = []
    monkeypatch.setattr(cell, "picture", picture)
    monkeypatch.setattr(
        "smartview_jax.picking.calibrating.calibrate", lambda data, progress: fitted.append(data)
    )
    found = calibrate_cell(cell, cell.board, drawn_calibration(), cell.arm, 8).data
    # By the nearest pose: views without the board are left out.
    true, reported = np.stack(poses), host_matrices(found.base_from_tool)
    gaps = np.linalg.norm(true[None, :, :3, 3] - reported[:, None, :3, 3], axis=2)
    actual = host_transforms(true[gaps.argmin(axis=1)])
    truth = cell.truth.calibration.uncorrected
    centres = np.asarray(truth.project(actual, found.points)[0])
    as_found, corrected = (
        np.nanmean(np.where(np.asarray(d.visible)[..., None], d.pixels - centres, np.nan), axis=1)
        for d in (found, fitted[0])
    )
    assert np.abs(as_found).max() > 0.08
    assert np.abs(corrected).max() < 0.3 * np.abs(as_found).max()
