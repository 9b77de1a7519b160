"""A depth sensor on a hand: what do its bias and its noise do to the hand-eye transform?

A board of 9 x 6 corners is measured by a sensor whose depths are 2 % and 1 mm too small and scatter
by 0.5 mm along the line of sight and 0.1 mm across it; a tenth of the corners has no depth, and in
some draws a tenth is off by centimetres. The robot has noise of 0.1 mm and 0.02 degrees. Each draw
has 15 poses. The poses of the board come from closed forms (Kabsch) on the points as they are, or
from `sv.depth`, which removes the bias; the hand-eye transform from OpenCV's `calibrateHandEye`
(Park) or from `fit_poses`. Printed are medians over the draws of the error of the hand-eye
translation, the bias that is found, and how the poses' errors relate to their stated covariances
(NEES, 6 if these are right).

    python -m benchmarks depth
"""

import sys

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.dataset import PoseDataset
from smartview_jax.geometry import host_exponentials, host_logarithms, host_matrices
from smartview_jax.targets import Chessboard

DRAWS, VIEWS = 20, 15
SCALE, OFFSET, ACROSS, ALONG = 1.02, 1e-3, 1e-4, 5e-4
ROBOT_SIGMAS = np.array([1e-4] * 3 + [np.deg2rad(0.02)] * 3)

TARGET = np.asarray(Chessboard(9, 6, 0.025).points)
TOOL_FROM_CAMERA = host_exponentials(np.array([0.03, -0.05, 0.08, 0.05, -0.1, 1.5]))
BASE_FROM_WORLD = host_exponentials(np.array([0.6, 0.1, 0.02, 0.1, 0.0, 0.4]))

MAX_BIAS_ERROR, NEES, MAX_ERROR_RATIO = 0.1, (5.0, 7.5), 0.1
"""Claims: error of the bias over the bias, mean NEES of the poses, and hand-eye error over the one
by closed forms."""

CLOSED_FORM = "Kabsch, OpenCV's calibrateHandEye"


def run(smoke: bool = False) -> bool:
    """Print the tables; True where the bias is found and the hand-eye transform gains.

    Args:
        smoke: whether to run three draws only.
    """
    holds = True
    for share in (0.0, 0.1):
        rows = [_draw(seed, share) for seed in range(3 if smoke else DRAWS)]
        print(f"{len(rows)} draws, {share:.0%} of the points wrong: hand-eye error, mm (median)")
        medians = {
            name: 1e3 * float(np.median([errors[name] for errors, _, _ in rows]))
            for name in rows[0][0]
        }
        for name, error in medians.items():
            print(f"  {name:42} {error:8.3f}")
        scales = np.array([scale for _, scale, _ in rows])
        nees = float(np.mean([of_draw for _, _, of_draw in rows]))
        off = float(np.abs(scales - SCALE).max() / (SCALE - 1.0))
        found = f"scale {scales.mean():.4f} ({SCALE}), at most {off:.0%} of the bias off"
        print(f"  {found}; NEES {nees:.1f}")
        holds &= off <= MAX_BIAS_ERROR and NEES[0] <= nees <= NEES[1]
        holds &= medians["sv.depth, fit_poses"] < MAX_ERROR_RATIO * medians[CLOSED_FORM]
    return holds


def _draw(seed: int, wrong: float) -> tuple[dict[str, float], float, float]:
    """Return the errors of a draw by method, m; the scale found, and the mean NEES of the poses."""
    rng = np.random.default_rng(seed)
    camera_from_world = _poses(rng)
    points = _measured(rng, camera_from_world, wrong)
    exact = BASE_FROM_WORLD @ np.linalg.inv(TOOL_FROM_CAMERA @ camera_from_world)
    base_from_tool = exact @ host_exponentials(ROBOT_SIGMAS * rng.normal(size=(VIEWS, 6)))
    found = sv.depth.poses_from_points(points, TARGET)
    tracked = {"Kabsch": _kabsch(points), "sv.depth": found.camera_from_world}
    errors = {}
    for name, poses in tracked.items():
        robot = list(base_from_tool[:, :3, :3]), list(base_from_tool[:, :3, 3])
        sensor = list(poses[:, :3, :3]), list(poses[:, :3, 3])
        _, t = cv2.calibrateHandEye(*robot, *sensor, method=cv2.CALIB_HAND_EYE_PARK)
        errors[f"{name}, OpenCV's calibrateHandEye"] = _distance(t[:, 0])
        fit = sv.fit_poses(PoseDataset.from_poses(base_from_tool, poses))
        inverse = np.linalg.inv(host_matrices(fit.calibration.camera_from_tool))
        errors[f"{name}, fit_poses"] = _distance(inverse[:3, 3])
    twists = host_logarithms(found.camera_from_world @ np.linalg.inv(camera_from_world))
    squares = np.einsum("vi,vij,vj->v", twists, np.linalg.inv(found.covariance), twists)
    return errors, found.scale, float(squares.mean())


def _distance(tool_from_camera: np.ndarray) -> float:
    """Return the error of the camera's place on the tool, m."""
    return float(np.linalg.norm(tool_from_camera - TOOL_FROM_CAMERA[:3, 3]))


def _poses(rng: np.random.Generator) -> np.ndarray:
    """Return poses of the board in the sensor's frame, tilted and at 0.4 to 0.8 m."""
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    turns = rng.normal(size=(VIEWS, 3)) * [0.35, 0.35, 1.0]
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :2, 3] = rng.uniform(-0.1, 0.0, (VIEWS, 2))
    poses[:, 2, 3] = rng.uniform(0.4, 0.8, VIEWS)
    return poses


def _measured(rng: np.random.Generator, poses: np.ndarray, wrong: float) -> np.ndarray:
    """Return the points as the sensor measures them; a share of them is wrong by centimetres."""
    points = TARGET @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    depth = points[..., 2:]
    points = points * ((depth - OFFSET) / SCALE / depth)
    rays = points / np.linalg.norm(points, axis=2, keepdims=True)
    noise = ACROSS * rng.normal(size=points.shape)
    noise += rays * (ALONG * rng.normal(size=depth.shape) - (noise * rays).sum(2, keepdims=True))
    is_wrong = rng.random(points.shape[:2]) < wrong
    noise[is_wrong] += 0.02 * rng.normal(size=(int(is_wrong.sum()), 3))
    points = points + noise
    points[rng.random(points.shape[:2]) < 0.1] = np.nan
    return points


def _kabsch(points: np.ndarray) -> np.ndarray:
    """Return the poses that fit the points best, each with the same weight."""
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    for pose, own in zip(poses, points, strict=True):
        seen = np.isfinite(own[:, 0])
        a, b = TARGET[seen], own[seen]
        turn = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))[0]
        pose[:3, :3] = turn.as_matrix()
        pose[:3, 3] = b.mean(axis=0) - turn.apply(a.mean(axis=0))
    return poses


if __name__ == "__main__":
    sys.exit(0 if run() else 1)
