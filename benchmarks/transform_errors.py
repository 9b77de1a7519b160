"""Errors of estimated transforms, alone and relative to their stated covariance."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smartview_jax.engine import step_names


def transform_errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return differences of translations, m, and rotation vectors between poses, rad, `(*n, 6)`."""
    turn = Rotation.from_matrix(found[..., :3, :3] @ truth[..., :3, :3].swapaxes(-1, -2))
    shift = found[..., :3, 3] - truth[..., :3, 3]
    return np.concatenate([shift, turn.as_rotvec()], axis=-1)


def stated_covariance(fit: Any, path: str) -> np.ndarray:
    """Return the covariance of translation and rotation that a fit states for a transform."""
    rows = [fit.parameter_names.index(name) for name in step_names(path)]
    return np.asarray(fit.covariance)[np.ix_(rows, rows)]


def squared_errors(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return the squared errors of transforms in units of their covariances, `(*n,)`."""
    return np.einsum("...i,...ij,...j->...", errors, np.linalg.inv(covariances), errors)
