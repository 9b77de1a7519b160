"""SciPy's least_squares with the analytic Jacobian, dense."""

import sys
import time
from pathlib import Path

START = time.perf_counter()

import numpy as np  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402


def main(path: Path, repeats: int) -> None:
    """Time one fit."""
    data = peer.load(path)
    views = [peer.View(data, k) for k in range(len(data.pixels))]

    def both(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [view(z[:5], z[5:11], z[11:]) for view in views]
        return np.concatenate([r for r, _ in parts]), np.concatenate([J for _, J in parts])

    def fit():
        return least_squares(
            lambda z: both(z)[0],
            np.concatenate([data.camera, np.zeros(12)]),
            jac=lambda z: both(z)[1],  # pyright: ignore[reportArgumentType]
            x_scale="jac",
            ftol=1e-12,
            xtol=1e-12,
            gtol=1e-12,
        )

    found, seconds, cold = timed(fit, repeats, START)
    report(seconds, float(found.cost), int(found.nfev), cold)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
