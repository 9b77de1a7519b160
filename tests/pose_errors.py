"""Compare poses on the host, where no program has to be compiled for every operation."""

import numpy as np

from smartview_jax.geometry import as_se3, host_logarithms, host_matrices


def motion_between(first, second) -> np.ndarray:
    """Tangents `(*views, 6)` that lead from the first poses to the second, translation first."""
    first, second = (host_matrices(as_se3(poses)) for poses in (first, second))
    return host_logarithms(np.linalg.inv(first) @ second)
