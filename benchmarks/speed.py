"""Each stage timed beside peers on the same data, in one run: medians of warm runs, and ratios.

The peers do less or the same: OpenCV's `calibrateCamera` is Step 2 alone, scipy's `least_squares`
is given the joint problem's residuals and Jacobian.
"""

import resource
import time
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import least_squares

import smartview_jax as sv
from smartview_jax.joint.build import build_problem
from smartview_jax.joint.parameters import Step
from smartview_jax.joint.problem import JointProblem
from smartview_jax.joint.solver import solve
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.staged import kalman_filter

SIZES = {"a": (5, 1000), "b": (50, 1000)}
SMOKE = {"a": (5, 100)}


def run(smoke: bool = False) -> bool:
    """Print the table; True where the joint fit agrees with scipy in cost."""
    agree = True
    print(f"{'problem':10}{'what':34}{'seconds':>10}{'ratio':>8}")
    for name, (views, points) in (SMOKE if smoke else SIZES).items():
        data, start, poses = _problem_of_size(views, points)
        timed = {
            "Step 2, Kalman filter": lambda d=data, s=start, p=poses: (
                kalman_filter(d.observations, s.camera, p).rms
            ),
            "Step 2, cv2.calibrateCamera": lambda d=data, s=start: _opencv(d, s),
        }
        _print(name, timed, smoke)
        problem = build_problem(data, start).problem
        costs = {}

        def ours(problem=problem, costs=costs):
            costs["ours"] = solve(problem)[0].costs[-1]

        def scipys(problem=problem, costs=costs):
            costs["scipy"] = _scipy(problem)

        _print(name, {"joint, optimistix": ours, "joint, scipy trf": scipys}, smoke)
        gap = abs(costs["ours"] / costs["scipy"] - 1.0)
        agree &= gap < 1e-6
        print(f"{name:10}costs differ by {gap:.1e} of their value")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"peak memory of the process {peak:.0f} MB")
    return agree


def _problem_of_size(views: int, points: int) -> tuple:
    side = round(np.sqrt(points))
    rng = np.random.default_rng(0)
    board = np.stack([*0.036 * rng.random((2, side * side)), np.zeros(side * side)], axis=1)
    scene = random_scene(0, views, board, paper_calibration(), translation_noise=1e-5)
    poses = scene.calibration.camera_from_world(scene.data.base_from_tool)
    return scene.data, scene.calibration, poses


def _print(problem: str, timed: dict[str, Callable[[], object]], smoke: bool) -> None:
    seconds = {name: [] for name in timed}
    for repeat in range(2 if smoke else 6):
        for name, function in timed.items():  # interleaved: both see the same machine
            began = time.perf_counter()
            jax.block_until_ready(function())
            if repeat:
                seconds[name].append(time.perf_counter() - began)
    first = float(np.median(next(iter(seconds.values()))))
    for name, values in seconds.items():
        median = float(np.median(values))
        print(f"{problem:10}{name:34}{median:10.4f}{median / first:8.2f}")


def _opencv(data: sv.Dataset, start: sv.Calibration) -> float:
    seen = np.asarray(data.visible)
    points = [p[s].astype(np.float32) for p, s in zip(np.asarray(data.points), seen, strict=True)]
    pixels = [p[s].astype(np.float32) for p, s in zip(np.asarray(data.pixels), seen, strict=True)]
    camera = start.camera
    matrix = np.array(
        [
            [float(camera.alpha_u), 0.0, float(camera.u0)],
            [0.0, float(camera.alpha_v), float(camera.v0)],
            [0.0, 0.0, 1.0],
        ]
    )
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    flags |= cv2.CALIB_ZERO_TANGENT_DIST
    return cv2.calibrateCamera(points, pixels, data.image_size, matrix, None, flags=flags)[0]


def _scipy(problem: JointProblem) -> float:
    found = least_squares(
        lambda z: np.asarray(_dense(problem, jnp.asarray(z))),
        np.zeros(len(problem.free)),
        jac=lambda z: np.asarray(_jacobian(problem, jnp.asarray(z))),  # pyright: ignore[reportArgumentType]
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    return float(found.cost)


@jax.jit
def _dense(problem: JointProblem, z: jax.Array) -> jax.Array:
    return ravel_pytree(problem.residuals(Step(z, jnp.zeros((0, 6)))))[0]


@jax.jit
def _jacobian(problem: JointProblem, z: jax.Array) -> jax.Array:
    return jax.jacfwd(lambda z: _dense(problem, z))(z)
