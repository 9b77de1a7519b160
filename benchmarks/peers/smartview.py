"""This library."""

import sys
import time
from pathlib import Path

START = time.perf_counter()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import smartview_jax as sv  # noqa: E402
from smartview_jax.cameras import AbstractPerspectiveLens, implicit_inverse  # noqa: E402
from smartview_jax.engine.problem_builder import build_problem  # noqa: E402
from smartview_jax.engine.sharding import shard  # noqa: E402
from smartview_jax.engine.solver import Solution, solve  # noqa: E402

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402


class ForwardRadial(AbstractPerspectiveLens):
    """OpenCV's k1 alone, as a user would write a lens of his own."""

    k1: jax.Array

    def distort_normalised(self, ideal):
        x, y = ideal[..., 0], ideal[..., 1]
        ratio = 1.0 + self.k1 * (x * x + y * y)
        return jnp.stack([x * ratio, y * ratio], axis=-1), 3.0 * ratio > 2.0

    def undistort_normalised(self, distorted):
        return implicit_inverse(lambda x: self.distort_normalised(x)[0], distorted, distorted)


def _matrix(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([pose, np.broadcast_to([[0.0, 0, 0, 1]], (*pose.shape[:-2], 1, 4))], -2)


def dataset_of(data: peer.Problem) -> sv.Dataset:
    """The problem's observations."""
    base_from_tool = np.linalg.inv(_matrix(data.tool_from_base))
    return sv.Dataset.from_arrays(data.points, data.pixels, base_from_tool, (640, 480))


def calibration_of(data: peer.Problem, lens: str) -> sv.Calibration:
    """Where the fit starts."""
    own = ForwardRadial(jnp.asarray(data.camera[4]))
    model = own if lens == "forward" else sv.cameras.Radial(0.0)
    alpha_u, alpha_v, u0, v0, _ = data.camera
    camera = sv.Camera(alpha_u, alpha_v, u0, v0, model, (640, 480))
    return sv.Calibration.eye_in_hand(
        camera, _matrix(data.camera_from_tool), _matrix(data.base_from_world)
    )


def main(path: Path, repeats: int, lens: str, call: str, devices: int = 1) -> None:
    """Time one fit, cold and warm, with its views on so many of the CPU's devices.

    The call is "fit_joint", which users call, or the "solve" of its least-squares problem alone.
    """
    jax.config.update("jax_num_cpu_devices", devices)
    data = peer.load(path)
    noise = sv.Noise(peer.PIXEL, peer.TRANSLATION, peer.ROTATION) if data.corrected else "trusted"
    dataset, start = dataset_of(data), calibration_of(data, lens)
    built = build_problem(dataset, start, noise=noise).problem
    if devices > 1:
        built = shard(built, jax.devices())
    whitened = 1.0 if data.corrected else peer.PIXEL**-2
    del data

    def fit() -> Solution:
        if call == "fit_joint":
            return sv.fit_joint(dataset, start, noise=noise).solution
        return jax.block_until_ready(solve(built))[0]

    solution, seconds, cold = timed(fit, repeats, START)
    report(seconds, solution.costs[-1] * whitened, solution.steps, cold)


if __name__ == "__main__":
    path, repeats, lens, call, *devices = sys.argv[1:]
    main(Path(path), int(repeats), lens, call, *map(int, devices))
