"""Simulate a camera on the hand of one arm that sees a target on the hand of another."""

import dataclasses

import numpy as np

from ..calibration import Calibration
from ..geometry import as_se3, host_exponentials, host_matrices, host_transforms
from ..targets import AbstractTarget
from .scenes import Scene, paper_calibration, random_viewpoints, reported_poses, simulate

OTHER_HAND = np.array([0.45, 0.0, 0.4])
"""Middle of the places of the hand with the target, in the base of its arm, m."""

DISTANCES, MAX_TILT = (0.17, 0.25), float(np.deg2rad(35.0))
"""Smallest and largest distance of the camera from the middle of the target (m), and largest tilt
from its z axis (rad)."""

REACH, TURN = 0.12, 0.35
"""Standard deviations of these places (m), and of rotation vectors of this hand (rad)."""


def two_hand_calibration() -> Calibration:
    """Return a true calibration: two arms 0.9 m apart that face each other, the paper's camera."""
    truth = paper_calibration()
    bases = host_exponentials(np.array([0.0, 0.0, 0.0, 0.05, -0.1, 2.9]))
    target = host_exponentials(np.array([0.0, 0.0, 0.0, 0.2, 0.1, 0.3]))
    bases[:3, 3], target[:3, 3] = (0.9, 0.1, 0.05), (0.02, -0.03, 0.06)
    return Calibration.hand_to_hand(truth.camera, truth.camera_from_tool, target, bases)


def random_two_hand_scene(
    seed: int,
    views: int,
    target: AbstractTarget,
    *,
    pixel_noise: float = 0.15,
    translation_noise: float = 0.0,
    rotation_noise: float = 0.0,
) -> Scene:
    """Return random views of a target that another arm holds in random poses.

    Args:
        seed: the same seed gives the same scene.
        views: number of views.
        target: the visible target; it is stored in the data set.
        pixel_noise: standard deviation of `u` and of `v`, px.
        translation_noise, rotation_noise: standard deviations of the reports of both arms, as in
            `simulate`.

    Returns:
        A scene whose `base_from_tool` are the true poses of the camera's hand in the other hand.
    """
    truth = two_hand_calibration()
    assert truth.base_from_other_base is not None
    rng = np.random.default_rng((seed, 1))
    seen = random_viewpoints(rng, views, target.points.mean(axis=0), DISTANCES, MAX_TILT)
    # With one hand in the place of the base, the pictures are as of a camera on a hand.
    ends = truth.camera_from_mount, truth.holder_from_world
    alone = Calibration.eye_in_hand(truth.camera, *ends, truth.target_scale)
    relative = alone.command_for(seen)
    other = host_exponentials(np.pad(TURN * rng.standard_normal((views, 3)), ((0, 0), (3, 0))))
    other[:, :3, 3] = OTHER_HAND + REACH * rng.standard_normal((views, 3))
    camera_hands = host_matrices(truth.base_from_other_base) @ other @ host_matrices(relative)
    scene = simulate(alone, relative, target.points, seed, pixel_noise)
    noise = np.random.default_rng((seed, 2))
    reports = [
        reported_poses(host_transforms(poses), noise, translation_noise, rotation_noise)
        for poses in (camera_hands, other)
    ]
    data = dataclasses.replace(scene.data, base_from_tool=reports[0], target=target)
    return Scene(data.between_hands(reports[1]), truth, as_se3(relative), scene.outliers)
