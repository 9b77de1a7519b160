"""Estimate the error that neighbouring outlines share, which makes a pose more uncertain.

The light that a smooth surface turns into sight displaces its outline (`shading`). To first order
one light displaces all outlines of a view, and is an unknown; the rest still differs little from an
outline to the next. A fit that takes these errors as independent is then less accurate than it
states. How much they share is seen in the residuals, whose neighbours have the same sign.
"""

import numpy as np
from jaxtyping import Float

from .pose_equations import PoseEquations


def light_correlations(equations: PoseEquations) -> Float[np.ndarray, "edges edges"]:
    """Return the correlations between the errors of different outlines by an unknown light.

    A distant light displaces an outline by its part along the view, if it is on the outline. For
    all directions of the light, equally probable, it is on both of two outlines at an angle a with
    the probability (1 - a / pi) / 2, and on one with 1 / 2.

    Args:
        equations: two of each edge, with the light of each view, which only outlines have.

    Returns:
        One on the diagonal; zero between edges of two views, and where an edge is no outline.
    """
    assert equations.by_light is not None
    # A shift of the object moves an outline across itself: along the surface's normal.
    normals = equations.by_pose[::2, :3]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    is_lit = np.abs(equations.by_light[::2]) > 0.0
    return np.where(is_lit @ is_lit.T, 1.0 - angles / np.pi, 0.0)


def variance_of_shared(
    residuals: Float[np.ndarray, "n"],
    remaining: Float[np.ndarray, "n n"],
    variances: Float[np.ndarray, "n"],
    shared: Float[np.ndarray, "n n"],
) -> float:
    """Return the size of an error that neighbours share, from the products of their residuals.

    A fit absorbs a part of it. The products of different residuals have their expected values for
    the size returned (Rao, "Estimation of variance and covariance components - MINQUE theory",
    1971).

    Args:
        residuals: of a fit by generalised least squares; some unknowns may have a prior.
        remaining: share of an error that is left in the residuals.
        variances: of the independent errors.
        shared: covariance of the shared errors for the size one.
    """
    # Products weighted by T = S / (v v^T), zero on the diagonal, of r = M (G u + e + s). With the
    # unknowns u of a prior P, M (V + G P G^T) M^T = M V, so that E = tr(T (M V + size M S M^T)).
    weights = shared / np.outer(variances, variances)
    np.fill_diagonal(weights, 0.0)
    expected = (weights * remaining * variances).sum()
    by_size = ((remaining.T @ weights @ remaining) * shared).sum()
    excess = residuals @ weights @ residuals - expected
    return float(excess / by_size) if min(excess, by_size) > 0.0 else 0.0
