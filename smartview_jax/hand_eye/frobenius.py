"""Compute the cost of Eq. 17 as a least-squares matrix.

Eq. 17 sums `|| T_i^-1 T_j X - X C_i^-1 C_j ||_F^2` over all pairs of views. It is quadratic in the
entries x of X, so all pairs together are `|| F x ||^2` with a small matrix F, which is computed
once. The sums over pairs reduce to sums over views: time and memory grow with the views, not with
their square. No square of a large number is subtracted from another, so that cost and F keep the
full precision of nearly exact poses.
"""

import numpy as np
from jaxtyping import Float


def frobenius_factor(
    T: Float[np.ndarray, "views 4 4"],
    C: Float[np.ndarray, "views 4 4"],
    weights: Float[np.ndarray, "views"],
    length_scale: float = 1.0,
) -> Float[np.ndarray, "rows 13"]:
    """Return the matrix F with `|| F x ||^2` the cost of Eq. 17, weighted.

    Pairs are weighted by the product of the weights of their views. The norm adds rotation entries
    to lengths, so its minimum depends on the unit of length, `length_scale` metres. The vector x
    has the nine entries of the rotation of X row by row, its translation, and 1.

    Args:
        T: robot poses as 4x4 matrices.
        C: camera poses.
        weights: of the views, not all zero.
        length_scale: metres per unit of length.
    """
    # With (P_i, p_i) and (Q_i, q_i) the rotations and translations of T_i and C_i, and (R, t) those
    # of X, the residual of a pair multiplied by the rotation P_i, which keeps its norm, is
    #
    #   rotation:     Y_j Q_j - Y_i Q_j,   so that its norm is |Y_j - Y_i|,   Y_i = P_i R Q_i^T
    #   translation:  (z_j - Y_i q_j) - (z_i - Y_i q_i),                      z_i = P_i t + p_i
    #
    # z and q are measured from their weighted means, which cancel in the differences. With W the
    # sum of the weights, Y the weighted mean of Y_i, D_i = Y_i - Y, and
    # G G^T = sum_j w_j q_j q_j^T, the sums over all pairs are
    #
    #   rotation:     2 W sum_i w_i |D_i|^2
    #   translation:  W sum_i w_i |z_i - Y_i q_i|^2 + W sum_j w_j |z_j - Y q_j|^2
    #                 + sum_i w_i |D_i G|^2
    views, total = len(weights), weights.sum()
    P, p, Q = T[:, :3, :3], T[:, :3, 3], C[:, :3, :3]
    q = C[:, :3, 3] - weights @ C[:, :3, 3] / total
    # The entries of Y_i and z_i as linear functions of x: (views, 3, 3, 13) and (views, 3, 13).
    Y, z = np.zeros((views, 3, 3, 13)), np.zeros((views, 3, 13))
    Y[..., :9] = np.einsum("iac,ibd->iabcd", P, Q).reshape(views, 3, 3, 9)
    z[..., 9:12], z[..., 12] = P, p
    z = z - np.einsum("i,iak->ak", weights, z) / total
    Y_mean = np.einsum("i,iabk->abk", weights, Y) / total
    D = Y - Y_mean
    root = np.sqrt(weights)[:, None, None]
    G = np.asarray(np.linalg.qr(root[:, 0] * q, mode="r")).T
    rows = [
        np.sqrt(2.0 * total) * root[..., None] * D,
        np.sqrt(total) / length_scale * root * (z - np.einsum("iabk,ib->iak", Y, q)),
        np.sqrt(total) / length_scale * root * (z - np.einsum("abk,ib->iak", Y_mean, q)),
        1.0 / length_scale * root[..., None] * np.einsum("iabk,bc->iack", D, G),
    ]
    # The triangular factor has the same norm for every x, and at most 13 rows.
    stacked = np.concatenate([block.reshape(-1, 13) for block in rows])
    return np.asarray(np.linalg.qr(stacked, mode="r"))
