"""Ceres from Python: one cost function a view, with the analytic Jacobian in NumPy."""

import sys
import time
from pathlib import Path

START = time.perf_counter()

import numpy as np  # noqa: E402
import pyceres  # noqa: E402  # pyright: ignore[reportMissingImports]

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402


class Cost(pyceres.CostFunction):
    """One view."""

    def __init__(self, view: peer.View, count: int, corrected: bool):
        super().__init__()
        self.view = view
        self.set_num_residuals(2 * count)
        self.set_parameter_block_sizes([5, 6, 6, 6] if corrected else [5, 6, 6])

    def Evaluate(self, parameters, residuals, jacobians):  # noqa: N802
        r, J = self.view(*parameters)
        residuals[:] = r
        if jacobians is not None:
            for block, columns in zip(jacobians, peer.columns_of(J), strict=True):
                if block is not None:
                    block[:] = columns.ravel()
        return True


class Prior(pyceres.CostFunction):
    """Of one view's pose correction."""

    def __init__(self):
        super().__init__()
        self.set_num_residuals(6)
        self.set_parameter_block_sizes([6])

    def Evaluate(self, parameters, residuals, jacobians):  # noqa: N802
        residuals[:] = parameters[0] / peer.PRIOR
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = np.diag(1.0 / peer.PRIOR).ravel()
        return True


def main(path: Path, repeats: int) -> None:
    """Time one fit."""
    data = peer.load(path)
    count = data.pixels.shape[1]

    def fit():
        shared = [data.camera.copy(), np.zeros(6), np.zeros(6)]
        own = [[np.zeros(6)] if data.corrected else [] for _ in data.pixels]
        problem = pyceres.Problem()
        costs = [Cost(peer.View(data, k), count, data.corrected) for k in range(len(data.pixels))]
        priors = [Prior() for mine in own if mine]
        for cost, mine in zip(costs, own, strict=True):
            problem.add_residual_block(cost, None, shared + mine)
        for prior, mine in zip(priors, own, strict=False):
            problem.add_residual_block(prior, None, mine)
        options = pyceres.SolverOptions()
        kinds = pyceres.LinearSolverType
        options.linear_solver_type = (
            kinds.DENSE_SCHUR if data.corrected else kinds.DENSE_NORMAL_CHOLESKY
        )
        options.function_tolerance = 1e-12
        options.num_threads = 1
        options.max_num_iterations = 100
        options.logging_type = pyceres.LoggingType.SILENT
        summary = pyceres.SolverSummary()
        pyceres.solve(options, problem, summary)
        return summary

    summary, seconds, cold = timed(fit, repeats, START)
    steps = summary.num_successful_steps + summary.num_unsuccessful_steps
    report(seconds, float(summary.final_cost), int(steps), cold)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
