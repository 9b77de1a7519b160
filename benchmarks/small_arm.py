"""A hobby arm of five axes whose joint zeros are wrong by degrees: what does its own prior gain?

The arm is like the SO-101 and its relatives: servos of hobby quality, a reach of 0.4 m, three
parallel axes, a camera on the gripper. The zeros of its three inner joints are set by eye, wrong by
1.5 degrees (the first and the last are equivalent to a turned base and a turned mount), and every
reading scatters by 0.3 degrees, as gears with play do. The readings of 20 views give the robot's
poses.

The default prior is one of industrial arms, which are fifty times better, so that it explains these
errors by noise of the poses. `SMALL_ARM` states what is known of such arms before any picture:
large errors of the zeros, and poses that scatter by millimetres.

    python -m benchmarks small_arm
"""

import argparse
import dataclasses
import sys
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

import smartview_jax as sv
from smartview_jax.cameras import Camera, OpenCV5
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.geometry import host_matrices
from smartview_jax.robot_errors import RobotPrior
from smartview_jax.robots import SerialArm
from smartview_jax.simulation import simulate
from smartview_jax.targets import Chessboard

SEEDS, VIEWS, HELD_OUT = 24, 20, 40

ZERO_STD, SCATTER, PIXEL_NOISE = np.deg2rad(1.5), np.deg2rad(0.3), 0.15

BOARD = Chessboard(6, 5, 0.02)

SMALL_ARM = RobotPrior(
    # A reach of 0.3 m times the scatter of a reading.
    translation_median=1e-3,
    rotation_median=float(SCATTER),
    group_medians={**RobotPrior().group_medians, "joint_offset": float(ZERO_STD)},
    # Zeros that were set by eye are wrong for certain.
    model_odds={"joint_offsets": 20.0},
)
"""Prior of an arm with hobby servos, after what its builders state."""

LOWEST, HIGHEST = np.deg2rad([[-50, -30, 20, 50, -90], [50, 30, 100, 120, 90]])
"""Joint readings from which views are drawn, rad."""

MARGIN = 20.0
"""Smallest distance of the board from the border of the picture, px."""


class Scene(NamedTuple):
    """Views to calibrate with, further views without scatter, and the truth."""

    data: sv.Dataset
    held_out: sv.Dataset
    truth: sv.Calibration


def run(smoke: bool = False, seeds: int = SEEDS) -> bool:
    """Print medians of both errors; True where the arm's own prior is not worse than the default's.

    Args:
        smoke: whether to run two seeds only.
        seeds: number of simulated arms.
    """
    fitters = {
        "robot trusted": {"noise": "trusted"},
        "default": {},
        "the arm's own prior": {"robot_prior": SMALL_ARM},
    }
    errors = {name: [] for name in fitters}
    for seed in range(2 if smoke else seeds):
        scene = small_arm_scene(seed)
        start = sv.fit_staged(scene.data, "opencv4").calibration
        for name, options in fitters.items():
            fit = sv.fit_joint(scene.data, start, **options)
            errors[name].append(_errors(fit.calibration, scene))
    print(f"medians of {len(errors['default'])} arms; {VIEWS} views, {HELD_OUT} held out")
    print(f"{'':22}{'held-out views, px':>20}{'hand-eye, mm':>14}{'better than default':>21}")
    for name, rows in errors.items():
        px, mm = np.median(rows, axis=0)
        better = sum(row[0] < other[0] for row, other in zip(rows, errors["default"], strict=True))
        print(f"{name:22}{px:20.2f}{1e3 * mm:14.2f}{better:21}", flush=True)
    medians = {name: np.median(rows, axis=0)[0] for name, rows in errors.items()}
    estimated = (medians["the arm's own prior"], medians["default"])
    return bool(max(estimated) <= medians["robot trusted"])


def small_arm() -> SerialArm:
    """Return an arm of five axes with a reach of 0.4 m: turn, three parallel axes, roll."""
    right = 0.5 * np.pi
    return SerialArm(
        theta=[0.0, -right, right, 0.0, 0.0],
        d=[0.119, 0.0, 0.0, 0.0, 0.16],
        a=[0.03, 0.116, 0.135, 0.0, 0.0],
        alpha=[-right, 0.0, 0.0, right, 0.0],
    )


def small_arm_scene(seed: int) -> Scene:
    """Return random views of a board on the table in front of an arm with errors."""
    rng = np.random.default_rng((seed, 5))
    arm, truth = small_arm(), _truth()
    zeros = ZERO_STD * rng.standard_normal(5) * [0, 1, 1, 1, 0]
    joints = _joints_that_see_the_board(rng, arm, truth, zeros)
    actual = joints + zeros
    actual[:VIEWS] += SCATTER * rng.standard_normal((VIEWS, 5))
    reported, poses = arm.base_from_tool(joints), arm.base_from_tool(actual)
    parts = []
    for part, noise in ((slice(VIEWS), PIXEL_NOISE), (slice(VIEWS, None), 0.0)):
        seen = simulate(truth, SE3(poses.wxyz_xyz[part]), BOARD.points, seed, noise).data
        seen = dataclasses.replace(seen, base_from_tool=SE3(reported.wxyz_xyz[part]))
        parts.append(seen.with_joints(joints[part], arm))
    data, held_out = parts
    return Scene(data, held_out, truth)


def _truth() -> sv.Calibration:
    """Return a webcam on the gripper, and the board on the table."""
    camera = Camera(600.0, 600.0, 320.0, 240.0, OpenCV5(-0.1, 0.05, 0.0, 0.0, 0.0), (640, 480))
    turn = SO3.from_rpy_radians(0.3, 0.02, 0.05)
    mount = SE3.from_rotation_and_translation(turn, jnp.array([0.0, 0.05, 0.06]))
    centre = np.asarray(BOARD.points).mean(axis=0)
    world = SE3.from_translation(jnp.array([0.30, 0.0, 0.0]) - centre)
    return sv.Calibration.eye_in_hand(camera, mount, world)


def _joints_that_see_the_board(
    rng: np.random.Generator, arm: SerialArm, truth: sv.Calibration, zeros: np.ndarray
) -> np.ndarray:
    """Return joint readings, rad, with which the whole board is in the picture, and not small."""
    chosen = np.zeros((0, 5))
    width, height = truth.camera.image_size
    while len(chosen) < VIEWS + HELD_OUT:
        joints = rng.uniform(LOWEST, HIGHEST, (4000, 5))
        views = host_matrices(truth.camera_from_world(arm.base_from_tool(joints + zeros)))
        points = np.asarray(BOARD.points) @ views[:, :3, :3].mT + views[:, None, :3, 3]
        pixels = 600.0 * points[..., :2] / points[..., 2:] + [320.0, 240.0]
        inside = (pixels > MARGIN) & (pixels < np.array([width, height]) - MARGIN)
        seen = inside.all(axis=(1, 2)) & (points[..., 2] > 0.1).all(axis=1)
        large = np.linalg.norm(pixels[:, 0] - pixels[:, -1], axis=1) > 0.25 * height
        chosen = np.concatenate([chosen, joints[seen & large]])
    return chosen[: VIEWS + HELD_OUT]


def _errors(calibration: sv.Calibration, scene: Scene) -> tuple[float, float]:
    """Return the RMS error of the held-out views (px), and the mount's translation error (m)."""
    rms = reprojection_errors(calibration, scene.held_out).rms
    found, true = (
        np.asarray(each.camera_from_tool.inverse().translation())
        for each in (calibration, scene.truth)
    )
    return float(rms), float(np.linalg.norm(found - true))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=SEEDS)
    sys.exit(0 if run(seeds=parser.parse_args().seeds) else 1)
