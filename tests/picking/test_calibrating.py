"""The views of the board, and what is said when it is not there."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.detection import circle_radii
from smartview_jax.geometry import host_matrices
from smartview_jax.picking import BoardViews, calibrate_cell
from smartview_jax.picking.calibrating import _planned_views, stacked_commands
from smartview_jax.robots import Command, six_axes
from smartview_jax.simulation import BOARD, drawn_calibration
from smartview_jax.simulation.arm_scenes import HOME_JOINTS
from smartview_jax.simulation.cell.truth import FOCAL_LENGTH, IMAGE_SIZE


def projected(points, camera_from_world):
    """Pixels of the drawing's camera, which has no distortion."""
    moved = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    return FOCAL_LENGTH * moved[..., :2] / moved[..., 2:] + 0.5 * np.array(IMAGE_SIZE)


class Blank:
    """A cell whose camera sees nothing."""

    def __init__(self):
        self.at = Command(drawn_calibration().command_for(np.eye(4)))

    def move(self, target):
        self.at = target
        return target

    def picture(self):
        return np.full(IMAGE_SIZE[::-1], 90, np.uint8)

    def set_gripper(self, width):
        return width

    def where(self):
        return self.at


class Drawn(Blank):
    """A cell that is exactly as it is drawn; its camera sees the circles of the board."""

    def __init__(self):
        joints = jnp.array(HOME_JOINTS)
        self.at = Command(six_axes().base_from_tool(joints), joints)

    def picture(self):
        angles = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
        ring = np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
        circles = BOARD.points[:, None] + circle_radii(BOARD.board)[:, None, None] * ring
        pixels = projected(circles, camera_from_world(self.at.base_from_tool))
        # Drawn large and averaged, so that the borders are where they should be.
        size, scale = np.array(IMAGE_SIZE[::-1]), 4
        large = np.full(scale * size, 200, np.uint8)
        cv2.fillPoly(large, list(np.rint(scale * (pixels + 0.5) - 0.5).astype(np.int32)), 40)
        return cv2.resize(large, IMAGE_SIZE, interpolation=cv2.INTER_AREA)


def camera_from_world(base_from_tool):
    drawing = drawn_calibration()
    base_from_world, camera_from_tool = map(
        host_matrices, (drawing.base_from_world, drawing.camera_from_tool)
    )
    return camera_from_tool @ np.linalg.inv(host_matrices(base_from_tool)) @ base_from_world


def test_a_board_that_is_not_found_is_said_with_the_number_of_views():
    with pytest.raises(ValueError, match="found in 0 of 7 views; expected at least 6"):
        calibrate_cell(Blank(), BOARD, drawn_calibration(), views=BoardViews(7))


def test_planned_views_show_most_of_the_board_from_many_sides():
    views = _planned_views(BOARD, BoardViews(24))
    pixels = np.stack([projected(BOARD.points, view) for view in views])
    inside = (pixels > 0.0).all(axis=-1) & (pixels < np.array(IMAGE_SIZE) - 1.0).all(axis=-1)
    # Some views are near and cut the board; the detector needs all of it in enough of them.
    assert np.median(inside.mean(axis=1)) > 0.95
    tilts = np.arccos(-views[:, 2, 2])
    assert tilts.min() < np.deg2rad(14.0)
    assert tilts.max() > np.deg2rad(25.0)


def test_planned_views_keep_to_their_limits():
    views = _planned_views(BOARD, BoardViews(24, 0, (1.0, 1.2), 0.1))
    centres = np.linalg.inv(views)[:, :3, 3]
    # Aimed next to the board's middle by a quarter of its size, along the axis of the camera.
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
        calibrate_cell(Blank(), BOARD, drawn_calibration(), views=BoardViews(**given))


def test_commands_are_stacked_with_joints_only_if_all_have_them():
    one = Command(drawn_calibration().command_for(np.eye(4)))
    stacked = stacked_commands([one, one])
    assert host_matrices(stacked.base_from_tool).shape == (2, 4, 4)
    assert stacked.joints is None


def test_what_perspective_makes_of_the_circles_is_corrected(monkeypatch):
    """Against where the true calibration sees the centres; as found they are 0.1 px off."""
    fitted = []
    monkeypatch.setattr(
        "smartview_jax.picking.calibrating.calibrate", lambda data, progress: fitted.append(data)
    )
    calibrated = calibrate_cell(Drawn(), BOARD, drawn_calibration(), six_axes(), BoardViews(8))
    data = calibrated.data
    assert data.joints is not None
    assert len(calibrated.pictures) == len(data.pixels) >= 6
    # The arm is exact: what it reports is true.
    poses = camera_from_world(data.base_from_tool)
    centres = np.stack([projected(BOARD.points, pose) for pose in poses])
    as_found, corrected = (
        np.nanmean(np.where(np.asarray(d.visible)[..., None], d.pixels - centres, np.nan), axis=1)
        for d in (data, fitted[0])
    )
    assert np.abs(as_found).max() > 0.08
    assert np.abs(corrected).max() < 0.3 * np.abs(as_found).max()
