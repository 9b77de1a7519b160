"""A stylus touches the target: how much nearer do its later touches come, and is that foretold?

A camera on the hand is calibrated from eight simulated views. By that calibration the stylus
touches the four corners of a square of 0.1 m, and the misses are measured with 0.05 mm. Then it
touches two other points, tilted otherwise, by the calibration as it was and by the corrected one
(`sv.correct_by_touches`). Printed are RMS misses in these later touches, the RMS that the
calibrations predicted, and the squared misses over their covariance (6 if that is right).

    python -m benchmarks touches
"""

import sys

import numpy as np
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.evaluation import stylus_error, touching_pose
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.grasping import stylus_orientations, tip_error_factor

DRAWS, VIEWS = 60, 8
ROBOTS = ((1e-4, 2e-4), (5e-4, 1e-3))
"""Noise of the robot: translation (m) and rotation (rad)."""

PIXEL_STD, MEASUREMENT_STD = 0.15, 5e-5
TIP = np.array([0.01, -0.02, 0.15])
MAX_PREDICTION_ERROR, CHI_SQUARE = 0.1, (4.5, 7.5)
"""Claims: deviation of the predicted from the actual RMS miss, and mean squared miss over its
covariance, which scatters by 0.45 about 6."""


def _touching(points: list[list[float]], tilts_deg: list[tuple[float, float]]) -> np.ndarray:
    """Return `world_from_tool` with the tip at each point, the stylus tilted in a direction."""
    down = np.diag([1.0, -1.0, -1.0])
    turns = [Rotation.from_euler("ZX", [b, a], degrees=True).as_matrix() for a, b in tilts_deg]
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = stylus_orientations(TIP, np.array(turns) @ down)
    rotations = host_transforms(poses).rotation()
    return host_matrices(touching_pose(TIP, rotations, np.array(points)))


TOUCHED = _touching(
    [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.1, 0.1, 0.0]],
    [(0.0, 0.0), (6.0, 0.0), (6.0, 120.0), (6.0, 240.0)],
)
LATER = _touching([[0.05, 0.05, 0.0], [0.02, 0.08, 0.02]], [(3.0, 60.0), (7.0, 170.0)])


def _draw(seed: int, translation: float, rotation: float) -> list[tuple[float, float, float]]:
    """Return squared miss, its prediction, and chi-square before and after the correction."""
    rng = np.random.default_rng(seed)
    scene = sv.simulation.random_scene(
        seed=seed,
        views=VIEWS,
        points=sv.simulation.paper_points(heights=(0.0, 0.02))[::6],
        translation_noise=translation,
        rotation_noise=rotation,
    )
    noise = sv.Noise(pixel=PIXEL_STD, translation=translation, rotation=rotation)
    fit = sv.calibrate(scene.data, "radial", noise=noise).joint

    def misses(calibration: sv.Calibration, poses: np.ndarray) -> np.ndarray:
        sigmas = np.repeat([translation, rotation], 3)
        twists = sigmas * rng.standard_normal((len(poses), 6))
        return np.asarray(
            stylus_error(calibration, scene.calibration, TIP, host_transforms(poses), twists)
        )

    touches = sv.tool_commands(fit.calibration, TOUCHED, estimate=fit)
    measured = misses(fit.calibration, TOUCHED)
    measured = measured + MEASUREMENT_STD * rng.standard_normal(measured.shape)
    corrected = sv.correct_by_touches(fit, touches, TIP, measured, measurement_std=MEASUREMENT_STD)
    rows = []
    for estimate in (fit, corrected):
        later = sv.tool_commands(estimate.calibration, LATER, estimate=estimate)
        factor = tip_error_factor(later, TIP)
        assert factor is not None
        error = misses(estimate.calibration, LATER)
        F = factor.reshape(error.size, -1)
        chi_square = error.ravel() @ np.linalg.solve(F @ F.T, error.ravel())
        rows.append((np.mean(np.sum(error**2, 1)), np.trace(F @ F.T) / len(error), chi_square))
    return rows


def run(smoke: bool = False) -> bool:
    """Print the table; True where all claims hold.

    Args:
        smoke: whether to run two draws only, which judge nothing.
    """
    holds = True
    print("robot mm, deg    calibration      RMS miss mm   predicted   squared miss (6)")
    for translation, rotation in ROBOTS:
        draws = np.array(
            [_draw(seed, translation, rotation) for seed in range(2 if smoke else DRAWS)]
        )
        for k, name in enumerate(("of pictures", "and of touches")):
            actual, predicted, chi_square = draws[:, k].mean(axis=0)
            actual, predicted = 1e3 * np.sqrt([actual, predicted])
            robot = f"{1e3 * translation:.1f}, {np.rad2deg(rotation):.3f}"
            print(f"{robot:16} {name:16} {actual:11.3f} {predicted:11.3f} {chi_square:18.2f}")
            if not smoke:
                holds &= abs(predicted / actual - 1.0) < MAX_PREDICTION_ERROR
                holds &= CHI_SQUARE[0] < chi_square < CHI_SQUARE[1]
    return bool(holds)


if __name__ == "__main__":
    sys.exit(not run())
