"""A camera on the hand of one arm and a board on the hand of another: scenes of both."""

import dataclasses
import functools
import math

import numpy as np
from once_a_run import computed_once

from smartview_jax import Calibration, Noise, Rig, fit_rig
from smartview_jax.geometry import host_exponentials
from smartview_jax.simulation import random_target_scene, random_two_hand_scene
from smartview_jax.targets import Chessboard

BOARD = Chessboard(4, 3, 0.0125)
"""Twelve points, for which the programs of the standard scene have room."""

TRANSLATION, ROTATION = 1e-4, 2e-4
"""Noise of the reports of each arm, m and rad."""

NOISE = Noise(0.15, math.sqrt(2.0) * TRANSLATION, math.sqrt(2.0) * ROTATION)
"""Noise of the scenes: both arms' errors add up."""

ONE_ARM = Noise(0.15, TRANSLATION, ROTATION)
"""Noise of a camera that sees one arm."""

KNOWN = {
    "noise": {"right": ONE_ARM, "left+right": NOISE},
    "field": None,
    "fixed": ("wrist.camera", "fixed.camera"),
}
"""Known cameras and noise of a rig: SciPy's reference has a few numbers less."""

TRANSFORMS = ("camera_from_tool", "other_tool_from_world", "base_from_other_base")


@functools.cache
def two_hands(seed, views=10):
    """The scene of this seed."""
    noise = {"translation_noise": TRANSLATION, "rotation_noise": ROTATION}
    return random_two_hand_scene(seed, views, BOARD, **noise)


def stepped(pose, step):
    """A transform after a step: rotated from the left, and its translation changed."""
    result = host_exponentials(np.concatenate([np.zeros(3), step[3:]])) @ pose
    result[:3, 3] = pose[:3, 3] + step[:3]
    return result


FIXED_CAMERA = host_exponentials(np.array([0.05, -0.1, 0.9, 0.3, -0.2, 0.1]))
"""Base of the right arm in the frame of a camera next to it."""


@functools.cache
def hands_rig(seed, views=8, fixed_views=6):
    """A camera on the left hand and one next to the right arm, which see the target on its hand.

    Returns:
        The rig, and the true calibrations.
    """
    scene = two_hands(seed, views)
    truth = scene.calibration
    fixed = Calibration.eye_to_hand(truth.camera, FIXED_CAMERA, truth.other_tool_from_world)
    noise = {"translation_noise": TRANSLATION, "rotation_noise": ROTATION}
    seen = random_target_scene(1000 + seed, fixed_views, BOARD, fixed, **noise).data
    seen = dataclasses.replace(seen, view_ids=tuple(f"fixed{k}" for k in range(fixed_views)))
    rig = Rig(
        {"wrist": scene.data, "fixed": seen},
        arms={"wrist": ("left", "right"), "fixed": "right"},
    )
    return rig, {"wrist": truth, "fixed": fixed}


def hands_fit(tmp_path_factory):
    """The fit of both cameras, whose lenses and noise are known."""
    return computed_once(tmp_path_factory, "hands", lambda: fit_rig(*hands_rig(0), **KNOWN))
