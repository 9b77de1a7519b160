"""Every stage timed against OpenCV on the same data, in one run: medians of warm runs, and ratios.

Step 2 is `cv2.calibrateCamera`'s job: by the paper's filter, and as a batch. Step 3 is
`cv2.calibrateHandEye`'s, whose closed forms do less than a search from every start. mrcal, where
some Python here has it (Debian: python3-mrcal), runs in a process of its own. The joint fit that
finds the sizes of all errors, and gross ones, is timed against the one that trusts the robot.
"""

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax.hand_eye import solve_hand_eye
from smartview_jax.simulation import Scene, paper_calibration, random_scene
from smartview_jax.staged import calibrate_views, kalman_filter

from .engine import measured

SIZES = ((5, 10, 20), (50, 25, 40))
SMOKE = ((5, 5, 10),)
"""Views, and rows and columns of the board."""

WIDTH = 0.036
"""Of a row of the board's points, m."""

PYTHONS = (sys.executable, "/usr/bin/python3")


def run(smoke: bool = False) -> bool:
    """Print the table; True where both ways of Step 2 end as OpenCV does, to a hundredth."""
    print(f"{'views':>5} {'points':>7}  {'what':32}{'seconds':>10}{'ratio':>8}{'RMS px':>9}")
    agree = [_size(*size, smoke) for size in (SMOKE if smoke else SIZES)]
    if not smoke:
        _estimating(*SIZES[-1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"peak memory of the process {peak:.0f} MB")
    return all(agree)


def _scene(views: int, rows: int, columns: int, **noise: Any) -> Scene:
    j, i = np.indices((rows, columns)).reshape(2, -1)
    board = WIDTH / columns * np.stack([i, j, np.zeros(len(i))], axis=1)
    return random_scene(0, views, board, paper_calibration(), **noise)


def _estimating(views: int, rows: int, columns: int) -> None:
    """Print what it costs that the joint fit finds the sizes of errors, and gross ones."""
    scene = _scene(views, rows, columns, translation_noise=1e-4, rotation_noise=1e-4)
    options: dict[str, dict[str, Any]] = {
        "trusted": {"noise": "trusted"},
        "estimated": {"noise": "estimated", "gross_errors": "keep"},
        "estimated, screened": {"noise": "estimated"},
    }

    def joint(chosen: dict[str, Any]) -> None:
        sv.fit_joint(scene.data, scene.calibration, **chosen)

    fits = {f"joint, {name}": partial(joint, chosen) for name, chosen in options.items()}
    _print_rows(views, rows * columns, *_interleaved(fits, 9))


def _size(views: int, rows: int, columns: int, smoke: bool) -> bool:
    points, spacing = rows * columns, WIDTH / columns
    scene = _scene(views, rows, columns, translation_noise=1e-5)
    data, camera = scene.data, scene.calibration.camera
    poses = scene.calibration.camera_from_world(data.base_from_tool)
    robot = data.base_from_tool.inverse()

    def step_one() -> None:
        jax.block_until_ready(
            calibrate_views(data.observations, data.image_size).alpha_relative_std
        )

    def step_three() -> None:
        solve_hand_eye(robot, poses)

    everything: dict[str, Callable[[], float | None]] = {
        "Step 2, cv2.calibrateCamera": lambda: _opencv(data, camera),
        "Step 2, as a batch": lambda: sv.fit_camera(data, camera, poses).rms,
        "Step 2, Kalman filter": lambda: float(kalman_filter(data.observations, camera, poses).rms),
        "Step 1, every view": step_one,
        "Step 3, BFGS from every start": step_three,
    }
    seconds, found = _interleaved(everything, 1 if smoke else 3)
    other = _mrcal(data, camera, poses, (rows, columns), spacing, 2 if smoke else 10)
    if other is not None:
        name = "Step 2, mrcal (8 numbers)"
        seconds[name], found[name] = other["seconds"], other["cost"]
    _print_rows(views, points, seconds, found)
    errors = [rms for rms in found.values() if rms is not None]
    return max(errors) < 1.01 * min(errors)


def _interleaved(
    functions: Mapping[str, Callable[[], float | None]], repeats: int
) -> tuple[dict[str, list[float]], dict[str, float | None]]:
    """Seconds of warm runs, and what the last gave, px; all in turn: they see the same machine."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    found: dict[str, float | None] = {}
    for repeat in range(1 + repeats):
        for name, function in functions.items():
            began = time.perf_counter()
            found[name] = function()
            if repeat:
                seconds[name].append(time.perf_counter() - began)
    return seconds, found


def _print_rows(
    views: int,
    points: int,
    seconds: Mapping[str, list[float]],
    found: Mapping[str, float | None],
) -> None:
    """Medians, and how many times the first's they are."""
    base = float(np.median(next(iter(seconds.values()))))
    for name, values in seconds.items():
        middle, rms = float(np.median(values)), found[name]
        print(
            f"{views:5} {views * points:7}  {name:32}{middle:10.4f}{middle / base:8.2f}"
            + ("" if rms is None else f"{rms:9.5f}")
        )


def _opencv(data: sv.Dataset, camera: sv.Camera) -> float:
    """OpenCV's own direction of distortion, with one number; its start is ours."""
    seen = np.asarray(data.visible)
    points = [p[s].astype(np.float32) for p, s in zip(np.asarray(data.points), seen, strict=True)]
    pixels = [p[s].astype(np.float32) for p, s in zip(np.asarray(data.pixels), seen, strict=True)]
    K = np.eye(3)
    K[[0, 1, 0, 1], [0, 1, 2, 2]] = [
        float(x) for x in (camera.alpha_u, camera.alpha_v, camera.u0, camera.v0)
    ]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_ZERO_TANGENT_DIST
    return cv2.calibrateCamera(points, pixels, data.image_size, K, None, flags=flags)[0]


def _mrcal(
    data: sv.Dataset,
    camera: sv.Camera,
    poses: SE3,
    shape: tuple[int, int],
    spacing: float,
    repeats: int,
) -> dict | None:
    """What `peers/mrcal_step2.py` printed; None where no Python here has mrcal."""
    able = [python for python in PYTHONS if _has_mrcal(python)]
    if not able:
        print("missing: mrcal (python3-mrcal)")
        return None
    seen = np.asarray(data.visible)
    # A negative weight is a point not seen; its pixel still has to be a number.
    weights = np.where(seen, 1.0, -1.0)[..., None]
    pixels = np.where(seen[..., None], np.asarray(data.pixels), 0.0)
    turns, shifts = poses.rotation().log(), poses.translation()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "board.npz"
        np.savez(
            path,
            board=np.concatenate([pixels, weights], axis=-1).reshape(len(seen), *shape, 3),
            poses=np.concatenate([turns, shifts], axis=-1),
            camera=np.array([camera.alpha_u, camera.alpha_v, camera.u0, camera.v0], dtype=float),
            image_size=data.image_size,
            spacing=spacing,
        )
        command = [able[0], "-m", "benchmarks.peers.mrcal_step2", str(path), str(repeats)]
        return measured(command)


def _has_mrcal(python: str) -> bool:
    try:
        return subprocess.run([python, "-c", "import mrcal"], capture_output=True).returncode == 0
    except FileNotFoundError:
        return False
