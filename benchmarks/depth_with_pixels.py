"""Depths at the corners of a grey picture: what do they add to a calibration by pixels?

An RGB-D camera on a hand (600 px, 640 x 480) sees a board of 9 x 6 corners at 0.4 to 0.9 m from 15
poses; its depths are 2 % and 1 mm too small, with a standard deviation of 0.5 mm nearby and 1.1 mm
at 1 m; a tenth of the corners has none. In one case all depths of a view have an error in common,
too, as sensors by time of flight have. Compared are OpenCV's `calibrateCamera` with
`calibrateHandEye` (Park), `sv.calibrate` on the pixels, and on pixels and depths. In the last case
the board is 2 % larger than stated, the robot is poor, and the sensor was calibrated before: its
scale is known to 0.2 %, its offset to 0.5 mm. `benchmarks.depth` prints it.

All cases have the same draws, so they do not confirm each other: of the first 30 the mean NEES is
7.2 to 8.1 in each of the first three cases, by chance; of the next 170 it is 6.2 to 6.4.
"""

import dataclasses
from typing import NamedTuple

import cv2
import numpy as np

import smartview_jax as sv
from smartview_jax.calibration import DepthBias
from smartview_jax.calibration_pipeline import CalibrationFit
from smartview_jax.dataset import Dataset, DepthNoise
from smartview_jax.geometry import host_matrices, host_transformed
from smartview_jax.simulation import paper_calibration, random_target_scene, simulate_depths
from smartview_jax.targets import Chessboard

from .transform_errors import squared_errors, stated_covariance, transform_errors

DRAWS, VIEWS = 200, 15
CAMERA = sv.Camera(600.0, 600.0, 322.0, 238.0, sv.cameras.Radial(-0.1), (640, 480))
BIAS, NOISE = DepthBias(1.02, 1e-3), DepthNoise(5e-4, 1e-3)
BOARD, SQUARE = (9, 6), 0.025
DISTANCES, TILT = (0.4, 0.9), float(np.deg2rad(35.0))
MISSING = 0.1

POINT = np.array([0.05, 0.05, 0.6])
"""The point before the camera whose error in the tool's frame is judged, m."""

KNOWN_SENSOR = {
    "depth_bias.scale": sv.Prior(mean=1.02, std=2e-3),
    "depth_bias.offset": sv.Prior(mean=1e-3, std=5e-4),
}
"""The priors of a sensor that was calibrated before."""


class Case(NamedTuple):
    """A case.

    Attributes:
        name: of the case.
        pixel: noise of u and of v, px.
        translation, rotation: noise of the robot, m and rad.
        common: error that all depths of a view have in common, m.
        true_size: true over stated size of the board.
        priors: what is known of the sensor.
    """

    name: str
    pixel: float
    translation: float
    rotation: float
    common: float = 0.0
    true_size: float = 1.0
    priors: dict[str, sv.Prior] | None = None


CASES = (
    Case("pixels 0.1 px, robot 0.1 mm and 0.02 deg", 0.1, 1e-4, np.deg2rad(0.02)),
    Case("pixels 0.3 px, robot 0.1 mm and 0.02 deg", 0.3, 1e-4, np.deg2rad(0.02)),
    Case("pixels 0.1 px, depths off by 3 mm by view", 0.1, 1e-4, np.deg2rad(0.02), 3e-3),
    Case("board 2 % larger, robot 1 mm", 0.1, 1e-3, np.deg2rad(0.1), 0.0, 1.02, KNOWN_SENSOR),
)

MAX_ROTATION_RATIO, MEAN_NEES, MAX_BIAS_ERROR = 1.0, (5.2, 7.2), 0.1
"""Claims: rotation error with depths over the one without, mean NEES of the hand-eye transform with
and without depths, and error of the scale over the bias where no error is common.

The mean of 200 values of NEES scatters by 0.25 about 6 if the covariances are right, and is a
little larger because the noise is estimated from 15 views. It is claimed where the board has its
stated size.
"""

PIXELS, BOTH = "sv.calibrate, pixels", "sv.calibrate, pixels and depths"


class _Errors(NamedTuple):
    """Errors of one fit.

    Attributes:
        translation, rotation: of the hand-eye transform, m and rad.
        point: of `POINT` in the tool's frame, m.
        nees: of the hand-eye transform; NaN without a covariance.
        size: of the board, found over true, minus 1; NaN where it is not estimated.
        size_std: the stated standard deviation of the size; NaN where it is not estimated.
        scale: of the depths, as found; NaN without depths.
    """

    translation: float
    rotation: float
    point: float
    nees: float = np.nan
    size: float = np.nan
    size_std: float = np.nan
    scale: float = np.nan


def run(smoke: bool = False) -> bool:
    """Print the tables; True where all claims hold.

    Args:
        smoke: whether to run two draws of the first case only, which judge no NEES.
    """
    holds = True
    for case in CASES[: 1 if smoke else None]:
        draws = [_draw(seed, case) for seed in range(2 if smoke else DRAWS)]
        print(f"{len(draws)} draws with depths at the corners, {case.name}:")
        for method in draws[0]:
            _print_row(method, np.array([draw[method] for draw in draws]))
        pixels, both = (np.array([draw[name] for draw in draws]) for name in (PIXELS, BOTH))
        if smoke:
            continue
        holds &= bool(_rms(both[:, 1]) < MAX_ROTATION_RATIO * _rms(pixels[:, 1]))
        for found in (pixels, both) if case.true_size == 1.0 else ():
            holds &= MEAN_NEES[0] < float(found[:, 3].mean()) < MEAN_NEES[1]
        if case.common == 0.0 and case.priors is None:
            off = np.abs(both[:, 6] - float(BIAS.scale)).max() / (float(BIAS.scale) - 1.0)
            holds &= bool(off <= MAX_BIAS_ERROR)
    return holds


def _rms(values: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _print_row(method: str, found: np.ndarray) -> None:
    """Print the errors of a method over all draws."""
    translation, rotation, point = (_rms(found[:, k]) for k in range(3))
    text = (
        f"  {method:43} {1e3 * translation:7.3f} mm, {np.rad2deg(rotation):.4f} deg, point "
        f"{1e3 * point:.3f} mm (RMS)"
    )
    if np.isfinite(found[:, 3]).all():
        text += f", NEES {found[:, 3].mean():.2f}"
    if np.isfinite(found[:, 5]).all():
        text += f", size off by {100 * _rms(found[:, 4]):.2f} % (+- {100 * found[:, 5].mean():.2f})"
    if np.isfinite(found[:, 6]).all():
        off = np.abs(found[:, 6] - float(BIAS.scale)).max() / (float(BIAS.scale) - 1.0)
        text += f", scale {found[:, 6].mean():.5f}, at most {off:.0%} of the bias off"
    print(text, flush=True)


def _draw(seed: int, case: Case) -> dict[str, _Errors]:
    """Return the errors of one draw by method."""
    truth = dataclasses.replace(paper_calibration(), camera=CAMERA)
    actual = Chessboard(*BOARD, SQUARE * case.true_size)
    scene = random_target_scene(
        seed,
        VIEWS,
        actual,
        truth,
        TILT,
        DISTANCES,
        pixel_noise=case.pixel,
        translation_noise=case.translation,
        rotation_noise=case.rotation,
    )
    rng = np.random.default_rng((seed, 7))
    poses = host_matrices(truth.camera_from_world(scene.base_from_tool))
    noise = dataclasses.replace(NOISE, common=case.common)
    depths = simulate_depths(poses, actual.points, BIAS, noise, rng, MISSING)
    stated = Chessboard(*BOARD, SQUARE)
    data = Dataset.from_arrays(
        stated.points,
        scene.data.pixels,
        scene.data.base_from_tool,
        CAMERA.image_size,
        target=stated,
    )
    tool_from_camera = np.linalg.inv(host_matrices(truth.camera_from_tool))
    both = sv.calibrate(data.with_depths(depths), "radial", priors=case.priors)
    return {
        "OpenCV's calibrateCamera, calibrateHandEye": _errors(_opencv(data), tool_from_camera),
        PIXELS: _fit_errors(sv.calibrate(data, "radial"), tool_from_camera, case),
        BOTH: _fit_errors(both, tool_from_camera, case),
    }


def _fit_errors(fit: CalibrationFit, truth: np.ndarray, case: Case) -> _Errors:
    """Return the errors of a fit, judged by its covariance."""
    camera_from_tool = host_matrices(fit.calibration.camera_from_tool)
    exact = np.linalg.inv(truth)
    error = transform_errors(camera_from_tool, exact)
    covariance = stated_covariance(fit, "camera_from_tool")
    return _errors(np.linalg.inv(camera_from_tool), truth)._replace(
        nees=float(squared_errors(error, covariance)),
        size=float(fit.calibration.target_scale) / case.true_size - 1.0,
        size_std=fit.std.get("target_scale", np.nan),
        scale=np.nan if fit.sensor is None else fit.sensor.scale,
    )


def _errors(tool_from_camera: np.ndarray, truth: np.ndarray) -> _Errors:
    """Return the errors of a hand-eye transform."""
    error = transform_errors(tool_from_camera, truth)
    point = host_transformed(tool_from_camera, POINT) - host_transformed(truth, POINT)
    return _Errors(
        float(np.linalg.norm(error[:3])),
        float(np.linalg.norm(error[3:])),
        float(np.linalg.norm(point)),
    )


def _opencv(data: Dataset) -> np.ndarray:
    """Return `tool_from_camera` by OpenCV: the camera by pixels, then the hand-eye transform."""
    seen, pixels = np.asarray(data.visible), np.asarray(data.pixels).astype(np.float32)
    points = np.asarray(data.points).astype(np.float32)
    usable = data.usable_views()
    objects = [points[k, seen[k]] for k in usable]
    images = [pixels[k, seen[k]] for k in usable]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    _, _, _, turns, places = cv2.calibrateCamera(
        objects, images, data.image_size, None, None, flags=flags
    )
    robot = host_matrices(data.base_from_tool)[usable]
    R, t = cv2.calibrateHandEye(
        list(robot[:, :3, :3]),
        list(robot[:, :3, 3]),
        [cv2.Rodrigues(turn)[0] for turn in turns],
        list(places),
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R, t[:, 0]
    return pose
