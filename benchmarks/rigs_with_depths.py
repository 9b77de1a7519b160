"""One camera of two on a hand measures depths too: what does each of them gain?

The paper's camera and a second one, 1 cm away, see the paper's points on two planes in 16 common
states of a robot with 0.1 mm and 0.2 mrad of noise (pixels 0.15 px). The first camera's depths are
2 % and 1 mm too small, with a standard deviation of 0.2 mm nearby and 2 mm at 1 m; a tenth of the
points has none. Printed are the errors of the hand-eye transforms, with their NEES (6 is ideal), of
the relative translation, and what is left of the sensor's scale error, with the NEES of scale and
offset (2 is ideal). `benchmarks.rigs` runs it.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax.calibration import Calibration, DepthBias
from smartview_jax.dataset import DepthNoise
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.simulation import paper_points, random_scene, simulate, simulate_depths

from .transform_errors import squared_errors, stated_covariance, transform_errors

DRAWS, VIEWS, PIXEL_NOISE = 30, 16, 0.15
BIAS, NOISE, MISSING = DepthBias(1.02, 1e-3), DepthNoise(2e-4, 2e-3), 0.1
ROBOT_TRANSLATION, ROBOT_ROTATION = 1e-4, 2e-4

RIGHT_FROM_LEFT = np.array([0.01, 0.0, 0.0, 0.0, 0.04, 0.0])
"""Twist from the first camera's frame into the second's."""

MAX_ERROR_RATIO = 1.0
"""Claim: the first camera's RMS errors with depths over those without."""

MEAN_NEES, SENSOR_NEES = (4.1, 7.9), (0.9, 3.1)
"""Claims: mean NEES of hand-eye transforms, and of the sensor's two numbers.

The means of 30 values of chi-square with six and two degrees of freedom scatter by 0.63 and 0.37;
the bounds are three times as far away.
"""


class _Errors(NamedTuple):
    """Errors of the two cameras in one draw.

    Attributes:
        translation, rotation: of the hand-eye transforms, m and rad, for each camera.
        nees: of the hand-eye transforms, for each camera.
        between: of the relative translation, m.
        scale: estimated minus true scale of the depths; NaN without depths.
        sensor: NEES of scale and offset of the depths; NaN without depths.
    """

    translation: tuple[float, float]
    rotation: tuple[float, float]
    nees: tuple[float, float]
    between: float
    scale: float
    sensor: float


def run(smoke: bool = False) -> bool:
    """Print the table; True where all claims hold.

    Args:
        smoke: whether to run one draw, which judges no errors.
    """
    draws = [_draw(seed) for seed in range(1 if smoke else DRAWS)]
    print(f"\n{len(draws)} pairs of cameras on a hand, RMS errors of left and right:")
    rms: dict[str, np.ndarray] = {}
    nees: dict[str, np.ndarray] = {}
    for kind in draws[0]:
        errors = [draw[kind] for draw in draws]
        millimetres = 1e3 * _rms([e.translation for e in errors])
        degrees = np.degrees(_rms([e.rotation for e in errors]))
        rms[kind] = np.array([millimetres[0], degrees[0]])
        nees[kind] = np.mean([e.nees for e in errors], axis=0)
        between = 1e3 * _rms([e.between for e in errors])
        print(
            f"  {kind:16}{_both(millimetres, 3)} mm, {_both(degrees, 4)} degrees, "
            f"NEES {_both(nees[kind], 1)}; relative translation {between:.3f} mm"
        )
    with_depths = [draw["with depths"] for draw in draws]
    left = _rms([e.scale for e in with_depths]) / (float(BIAS.scale) - 1.0)
    sensor = float(np.mean([e.sensor for e in with_depths]))
    print(f"  of the sensor's scale error {left:.1%} is left (RMS), NEES {sensor:.1f}")
    if smoke:
        return bool(left <= 1.0)
    means = np.concatenate(list(nees.values()))
    gains = rms["with depths"] <= MAX_ERROR_RATIO * rms["pixels alone"]
    return bool(
        gains.all()
        and ((MEAN_NEES[0] < means) & (means < MEAN_NEES[1])).all()
        and SENSOR_NEES[0] < sensor < SENSOR_NEES[1]
    )


def _rms(values: list) -> np.ndarray:
    """Return the root of the mean square over the draws."""
    return np.sqrt(np.mean(np.square(values), axis=0))


def _both(values: np.ndarray, digits: int) -> str:
    """Return a value of each camera as text."""
    return " and ".join(f"{value:.{digits}f}" for value in values)


def _draw(seed: int) -> dict[str, _Errors]:
    """Return the errors of one draw without and with depths."""
    scene = random_scene(
        seed,
        VIEWS,
        paper_points((0.0, 0.02))[::6],
        pixel_noise=PIXEL_NOISE,
        translation_noise=ROBOT_TRANSLATION,
        rotation_noise=ROBOT_ROTATION,
    )
    left, points = scene.calibration, np.asarray(scene.data.points)
    placed = host_exponentials(RIGHT_FROM_LEFT) @ host_matrices(left.camera_from_mount)
    right = dataclasses.replace(left, camera_from_mount=host_transforms(placed))
    seen = simulate(right, scene.base_from_tool, points[0], 1000 + seed, PIXEL_NOISE).data
    truths = {"left": left, "right": right}
    data = {
        "left": scene.data,
        "right": dataclasses.replace(
            seen, base_from_tool=scene.data.base_from_tool, view_ids=scene.data.view_ids
        ),
    }
    rng = np.random.default_rng((seed, 3))
    poses = host_matrices(left.camera_from_world(scene.base_from_tool))
    depths = simulate_depths(poses, points[0], BIAS, NOISE, rng, MISSING)
    with_depths = {**data, "left": data["left"].with_depths(depths)}
    return {
        "pixels alone": _errors(sv.calibrate(sv.Rig(data), "radial"), truths),
        "with depths": _errors(sv.calibrate(sv.Rig(with_depths), "radial"), truths),
    }


def _errors(fit: sv.RigFit, truths: dict[str, Calibration]) -> _Errors:
    """Return the errors of a fit of both cameras."""
    errors = {
        name: _against_stated(fit, name, truth.camera_from_mount) for name, truth in truths.items()
    }
    translation, rotation, nees = zip(*errors.values(), strict=True)
    a, b = (host_matrices(truth.camera_from_mount) for truth in truths.values())
    between = host_matrices(fit.relative("left", "right").transform) - a @ np.linalg.inv(b)
    distance = float(np.linalg.norm(between[:3, 3]))
    sensor = fit.sensors.get("left")
    if sensor is None:
        return _Errors(translation, rotation, nees, distance, np.nan, np.nan)
    off = np.array([sensor.scale - float(BIAS.scale), sensor.offset - float(BIAS.offset)])
    sensor_nees = float(off @ np.linalg.solve(sensor.covariance, off))
    return _Errors(translation, rotation, nees, distance, float(off[0]), sensor_nees)


def _against_stated(fit: sv.RigFit, name: str, truth: SE3) -> tuple[float, float, float]:
    """Return the errors of a hand-eye transform, m and rad, and its NEES."""
    found = host_matrices(fit.calibrations[name].camera_from_mount)
    error = transform_errors(found, host_matrices(truth))
    nees = squared_errors(error, stated_covariance(fit, f"{name}.camera_from_tool"))
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])), float(nees)
