"""Two arms that see the same targets, each from a base of its own."""

import dataclasses
import functools

import numpy as np
from fit_scenes import scene_with
from jaxlie import SE3
from once_a_run import computed_once

from smartview_jax import Noise, Rig, fit_rig
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.simulation import paper_calibration

LEFT_FROM_RIGHT = host_exponentials(np.array([0.9, -0.4, 0.1, 0.1, -0.2, 1.9]))
"""Base of the right arm in the base of the left one: turned by 110 degrees, 0.85 m away."""

WALL_FROM_TABLE = host_exponentials(np.array([0.15, 0.05, 0.1, 0.3, 0.2, 0.1]))
"""Where the second target is, from the first."""

FOUR_CAMERAS = ("left_table", "left_wall", "right_table", "right_wall")
"""Two cameras on each arm, so that two targets connect them."""

NOISE = Noise(0.15, 1e-4, 2e-4)
"""Noise of the scenes."""

LENSES = tuple(f"{camera}.camera" for camera in FOUR_CAMERAS)
"""Paths of the lenses of four cameras."""


def truth_of(camera, moved=0.0):
    """The true calibration of a camera: `left_wall` is on the left arm and sees the wall.

    For the right arm the wall may be moved along x by some length, m.
    """
    arm, target = camera.split("_")
    truth = paper_calibration()
    world = host_matrices(truth.holder_from_world)
    if target == "wall":
        world = world @ WALL_FROM_TABLE
    if arm == "right":
        world[0, 3] += moved if target == "wall" else 0.0
        world = np.linalg.inv(LEFT_FROM_RIGHT) @ world
    turn = host_exponentials(0.02 * np.random.default_rng(len(camera)).standard_normal(6))
    hand = host_transforms(turn @ host_matrices(truth.camera_from_mount))
    return dataclasses.replace(
        truth, camera_from_mount=hand, holder_from_world=host_transforms(world)
    )


@functools.cache
def arms_scene(seed, cameras=("left_table", "right_table"), views=8, moved=0.0, right_noise=1.0):
    """The rig of these cameras, and the true calibrations.

    The noise of the right arm is so many times the left one's.
    """
    data, truths = {}, {}
    for k, camera in enumerate(cameras):
        truths[camera] = truth_of(camera, moved)
        times = right_noise if camera.startswith("right") else 1.0
        noise = {
            "translation_noise": times * NOISE.translation,
            "rotation_noise": times * NOISE.rotation,
        }
        seen = scene_with(truths[camera], 100 * seed + k, views, **noise).data
        # Both arms have a state `table0`.
        target = camera.split("_")[1]
        names = tuple(f"{target}{view}" for view in range(views))
        data[camera] = dataclasses.replace(seen, view_ids=names)
    arms = {camera: camera.split("_")[0] for camera in cameras}
    targets = {camera: camera.split("_")[1] for camera in cameras}
    return Rig(data, targets, arms), truths


def arms_fit(tmp_path_factory, moved=0.0):
    """The fit of the four cameras in few states, with known lenses and noise."""

    def fit():
        rig, truths = arms_scene(0, FOUR_CAMERAS, 4, moved)
        return fit_rig(rig, truths, noise={"left": NOISE, "right": NOISE}, fixed=LENSES)

    return computed_once(tmp_path_factory, f"arms_{moved}", fit)


def base_error(relative):
    """The error of an estimated `LEFT_FROM_RIGHT`: of its translation, and a rotation after it."""
    found = host_matrices(relative.transform)
    turn = SE3.from_matrix(found @ np.linalg.inv(LEFT_FROM_RIGHT)).rotation().log()
    return np.concatenate([found[:3, 3] - LEFT_FROM_RIGHT[:3, 3], np.asarray(turn)])
