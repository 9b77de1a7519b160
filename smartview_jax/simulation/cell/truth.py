"""Draw the true state of a cell at random: lens, hand-eye transform and arm.

Joints 2 to 5 have errors of 0.05 degrees, their links of 0.3 mm and 0.03 degrees, the arm repeats a
pose to 0.02 mm and 0.003 degrees, and the lens has a distortion of the sixth degree, beyond the
usual four coefficients.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from ...calibration import Calibration
from ...cameras import Camera, OpenCV5, Pinhole
from ...geometry import host_exponentials, host_matrices, host_poses, host_transforms
from ...robots import SerialArm, six_axes
from ...targets import AbstractTarget, CircleGrid, StackedTarget
from ..arm_scenes import random_kinematic_errors

BOARD = StackedTarget(
    CircleGrid(7, 9, 0.03, origin_mark=True, radius=0.0075, mark_radius=0.01125), (0.0,)
)
"""The board that calibrates the cell; it lies on the table, and its frame is the cell's world."""

TRANSLATION_NOISE, ROTATION_NOISE = 2e-5, float(np.deg2rad(0.003))
"""Repeatability of the arm: standard deviations per axis, m and rad."""

MOUNT_SPREAD = np.repeat([4e-3, np.deg2rad(2.0)], 3)
"""Standard deviations of hand-eye transform and base from the drawing, m and rad."""

IMAGE_SIZE, FOCAL_LENGTH = (1280, 800), 1400.0
"""Size of the pictures and focal length, px: 1 megapixel, 0.3 mm a pixel at 0.45 m."""


@dataclasses.dataclass(frozen=True, eq=False)
class CellTruth:
    """The true state of a cell, for the simulation and its judge only.

    Attributes:
        calibration: true camera, mount and world, including the arm's error.
        arm: the nominal arm, which is known to everyone.
        board: the board on the table.
        translation_noise, rotation_noise: repeatability of the arm, m and rad.
    """

    calibration: Calibration
    arm: SerialArm
    board: AbstractTarget = BOARD
    translation_noise: float = TRANSLATION_NOISE
    rotation_noise: float = ROTATION_NOISE

    def base_from_tool(
        self, joints: Float[np.ndarray, "joints"], rng: np.random.Generator
    ) -> Float[np.ndarray, "4 4"]:
        """Return the true pose of the tool at joint readings, with the arm's random error, m."""
        error = self.calibration.robot_error
        command = self.arm.command(joints)
        actual = command.base_from_tool if error is None else error.actual_pose(command)
        # The arm does not return to exactly the same place.
        sigmas = np.repeat([self.translation_noise, self.rotation_noise], 3)
        return host_matrices(actual) @ host_exponentials(sigmas * rng.standard_normal(6))

    @property
    def world_from_base(self) -> Float[np.ndarray, "4 4"]:
        """The true pose of the base in the world, m."""
        return np.linalg.inv(host_matrices(self.calibration.base_from_world))


def random_truth(seed: int = 0, error_scale: float = 1.0) -> CellTruth:
    """Return the true state of a cell by its seed, with errors scaled from the module's values."""
    rng, arm, drawn = np.random.default_rng((seed, 9)), six_axes(), drawn_calibration()
    # The last coefficient is beyond the usual four.
    lens = OpenCV5(-0.126, 0.0695, 1e-4, 3e-4, -0.03)
    camera = Camera(FOCAL_LENGTH, 0.9995 * FOCAL_LENGTH, 645.0, 392.0, lens, image_size=IMAGE_SIZE)
    mounts = host_exponentials(MOUNT_SPREAD * rng.standard_normal((2, 6)))
    calibration = Calibration.eye_in_hand(
        camera,
        host_transforms(mounts[0] @ host_matrices(drawn.camera_from_tool)),
        host_transforms(host_matrices(drawn.base_from_world) @ mounts[1]),
    )
    error = random_kinematic_errors(arm, rng, error_scale)
    return CellTruth(dataclasses.replace(calibration, robot_error=error), arm)


def drawn_calibration() -> Calibration:
    """Return the cell according to its drawing, used to plan the first views of the board.

    The camera looks along the fingers, 90 mm from them, through a lens without distortion.
    """
    width, height = IMAGE_SIZE
    camera = Camera(
        FOCAL_LENGTH, FOCAL_LENGTH, 0.5 * width, 0.5 * height, Pinhole(), image_size=IMAGE_SIZE
    )
    places = np.array([[0.0, -0.09, -0.02], [0.8, 0.06, 0.02]])
    camera_from_tool, base_from_world = map(host_transforms, host_poses(np.eye(3), places))
    return Calibration.eye_in_hand(camera, camera_from_tool, base_from_world)
