"""GTSAM from Python: one custom factor a view, with the analytic Jacobian in NumPy."""

import sys
import time
from pathlib import Path

START = time.perf_counter()

import gtsam  # noqa: E402  # pyright: ignore[reportMissingImports]
import numpy as np  # noqa: E402

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402

SHARED = [0, 1, 2]
"""Keys of the camera and of both steps; the keys of the views' corrections follow."""


def main(path: Path, repeats: int) -> None:
    """Time one fit."""
    data = peer.load(path)
    views = len(data.pixels)

    def fit():
        graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for key, value in zip(SHARED, (data.camera, np.zeros(6), np.zeros(6)), strict=True):
            start.insert(key, value)
        unit = gtsam.noiseModel.Unit.Create(2 * data.pixels.shape[1])
        prior = gtsam.noiseModel.Diagonal.Sigmas(peer.PRIOR)
        for k in range(views):
            own = [len(SHARED) + k] if data.corrected else []
            graph.add(gtsam.CustomFactor(unit, SHARED + own, _error(peer.View(data, k))))
            for key in own:
                start.insert(key, np.zeros(6))
                graph.add(gtsam.PriorFactorVector(key, np.zeros(6), prior))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(1e-12)
        parameters.setAbsoluteErrorTol(0.0)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
        optimizer.optimize()
        return optimizer

    found, seconds, cold = timed(fit, repeats, START)
    report(seconds, float(found.error()), int(found.iterations()), cold)


def _error(view: peer.View):
    def error(this, values, jacobians):
        r, J = view(*(values.atVector(key) for key in this.keys()))  # noqa: SIM118
        if jacobians is not None:
            for k, columns in enumerate(peer.columns_of(J)):
                jacobians[k] = columns
        return r

    return error


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
