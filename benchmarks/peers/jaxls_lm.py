"""jaxls: Levenberg-Marquardt in JAX, with derivatives by forward differentiation of each view.

The package index has it as `almond-jaxls`, a fork that installs the module `jaxls` without its
Schur elimination. Its dense solver does not run in double precision, so that the steps are found by
conjugate gradients.
"""

import sys
import time
from pathlib import Path

START = time.perf_counter()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import jaxlie  # noqa: E402
import jaxls  # noqa: E402  # pyright: ignore[reportMissingImports]
import numpy as np  # noqa: E402
from loguru import logger  # noqa: E402  # pyright: ignore[reportMissingImports]

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402

TERMINATION = {
    "cost_tolerance": 1e-14,
    "gradient_tolerance": 1e-10,
    "parameter_tolerance": 1e-12,
    "max_iterations": 50,
}


class CameraVar(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(5)):  # pyright: ignore
    """alpha_u, alpha_v, u0, v0 and k1."""


class Correction(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(6)):  # pyright: ignore
    """The twist of a view's pose."""


def _residual(camera, camera_from_tool, robot, base_from_world, points, pixels):
    """Return measured minus predicted pixels of one view, in standard deviations."""
    pose = camera_from_tool @ robot @ base_from_world
    p = points @ pose.rotation().as_matrix().T + pose.translation()
    xy = p[:, :2] / p[:, 2:]
    ratio = 1.0 + camera[4] * (xy**2).sum(axis=1, keepdims=True)
    return ((pixels - camera[:2] * xy * ratio - camera[2:4]) / peer.PIXEL).ravel()


def main(path: Path, repeats: int) -> None:
    """Time one fit."""
    logger.disable("jaxls")
    data = peer.load(path)
    views = len(data.pixels)
    points = jnp.asarray(data.points)
    camera, hand, world = CameraVar(0), jaxls.SE3Var(0), jaxls.SE3Var(1)
    robot, pixels = _pose(data.tool_from_base), jnp.asarray(data.pixels)
    variables: list = [camera, hand, world]
    start = [
        camera.with_value(jnp.asarray(data.camera)),
        hand.with_value(_pose(data.camera_from_tool)),
        world.with_value(_pose(data.base_from_world)),
    ]

    def reported(values, camera, hand, world, robot, pixels):
        return _residual(values[camera], values[hand], robot, values[world], points, pixels)

    def corrected(values, camera, hand, world, correction, robot, pixels):
        moved = jaxlie.SE3.exp(values[correction]) @ robot
        return _residual(values[camera], values[hand], moved, values[world], points, pixels)

    def prior(values, correction):
        return values[correction] / jnp.asarray(peer.PRIOR)

    # Each view's cost names the variables that all views share.
    first, second = (jnp.full(views, k, dtype=jnp.int32) for k in (0, 1))
    cameras, hands, worlds = CameraVar(first), jaxls.SE3Var(first), jaxls.SE3Var(second)
    if data.corrected:
        corrections = Correction(jnp.arange(views, dtype=jnp.int32))
        costs = [
            jaxls.Cost.factory(corrected)(cameras, hands, worlds, corrections, robot, pixels),
            jaxls.Cost.factory(prior)(corrections),
        ]
        variables.append(corrections)
        start.append(corrections)
    else:
        costs = [jaxls.Cost.factory(reported)(cameras, hands, worlds, robot, pixels)]
    graph = jaxls.LeastSquaresProblem(costs, variables).analyze()
    values = jaxls.VarValues.make(start)

    def fit():
        found = graph.solve(
            values,
            linear_solver=jaxls.ConjugateGradientConfig(1e-12, 1e-6),
            trust_region=jaxls.TrustRegionConfig(lambda_min=1e-12),
            termination=jaxls.TerminationConfig(**TERMINATION),
            verbose=False,
            return_summary=True,
        )
        return jax.block_until_ready(found)

    (found, summary), seconds, cold = timed(fit, repeats, START)
    cost = 0.5 * float(jnp.sum(graph.compute_residual_vector(found) ** 2))
    report(seconds, cost, int(summary.iterations), cold)


def _pose(matrices: np.ndarray) -> jaxlie.SE3:
    """Return 3 x 4 transforms as jaxlie has them."""
    rows = np.broadcast_to([[0.0, 0.0, 0.0, 1.0]], (*matrices.shape[:-2], 1, 4))
    return jaxlie.SE3.from_matrix(jnp.asarray(np.concatenate([matrices, rows], axis=-2)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
