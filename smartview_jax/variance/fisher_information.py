"""Fisher information of the standard deviations of errors, by the restricted likelihood."""

from jaxtyping import Float

from ..runtime.array_namespace import AnyArray, array_namespace
from .likelihood import Marginalisation, with_added_diagonal
from .linearised_views import Kinds, LinearisedViews, rows_of_views
from .standard_deviations import IS_POSE_KIND


def fisher_information(
    views: LinearisedViews, marginal: Marginalisation, kinds: Kinds
) -> Float[AnyArray, "*searches kinds kinds"]:
    """Compute the Fisher information matrix of the logarithms of the standard deviations.

    With P_j the prior precisions of one kind of random number j, n_j their count, and C the
    covariance of all marginalised parameters, the information of the logarithms of two precisions
    is half of

        tr(C P_j C P_k) + [j = k] (n_j - 2 tr(C P_j))

    The entries of the pixels follow, because the precisions of the pixels and of all priors add up
    to the inverse of C.

    Args:
        views: the linearised views.
        marginal: result of `marginalise` at the standard deviations in question.
        kinds: result of `kinds_of` for the views.
    """
    xp = array_namespace(marginal.shared_whitening)
    # P_j as rows of weights: the groups of the field, and last the parameters with a known prior.
    has_known_prior = (views.group_index < 0).astype(float)
    members = xp.concatenate([kinds.groups, has_known_prior[..., None, :]], axis=-2)
    shared_precisions = members * marginal.prior_precision.shared[..., None, :]
    product_traces = _traces_of_products(marginal, shared_precisions)
    traces = _traces(marginal, shared_precisions)

    count, shared_count = kinds.counts, shared_precisions.shape[-1]
    parameter_count = views.per_view_free.sum(dtype=float) + shared_count
    # C^-1 = P_0 + sum_j P_j with P_0 the information of the pixels. C P_0 = 1 - sum_j C P_j in the
    # formula above, with N the number of marginalised parameters, gives
    # (0, 0): n_0 - N + sum_jk tr(C P_j C P_k),  (0, j): tr(C P_j) - sum_k tr(C P_j C P_k).
    pixel = count[..., 0] - parameter_count + product_traces.sum(axis=(-2, -1))
    pixel_robot = (traces - product_traces.sum(axis=-1))[..., :-1]
    robot = with_added_diagonal(
        product_traces[..., :-1, :-1], count[..., 1:] - 2.0 * traces[..., :-1]
    )
    # log sigma = -log(precision) / 2: a factor of 4, times the half of the formula.
    return 2.0 * _arranged(pixel[..., None, None], pixel_robot[..., None, :], robot)


def _traces(
    marginal: Marginalisation, shared_precisions: Float[AnyArray, "*searches groups shared"]
) -> Float[AnyArray, "*searches kinds"]:
    """Return tr(C P_j) for each kind j: translation, rotation, groups, known priors."""
    xp = array_namespace(marginal.shared_whitening)
    diagonal = marginal.per_view_covariance.diagonal(axis1=-2, axis2=-1)
    variance = marginal.shared_covariance.diagonal(axis1=-2, axis2=-1)
    of_poses = (marginal.prior_precision.per_view * diagonal).sum(axis=-2) @ IS_POSE_KIND.T
    of_shared = (shared_precisions @ variance[..., None])[..., 0]
    return xp.concatenate([of_poses, of_shared], axis=-1)


def _traces_of_products(
    marginal: Marginalisation, shared_precisions: Float[AnyArray, "*searches groups shared"]
) -> Float[AnyArray, "*searches kinds kinds"]:
    """Return tr(C P_j C P_k) for all pairs of kinds, in the order of `_traces`."""
    # C has the blocks of `Marginalisation`, and C_vw = K_v C_ss K_w^T for two different views. P_j
    # are diagonal: tr(C P_j C P_k) = sum_ab P_j,a C_ab^2 P_k,b, summed block by block. For the
    # blocks of the views, with N_j = sum_v K_v^T P_j K_v, where only three rows of a view belong to
    # a kind: the diagonal of C_ss N_j C_ss holds the sums of squares between a kind and each shared
    # parameter, and tr(N_j C_ss N_k C_ss) is the sum over all pairs of views. It needs a correction
    # for the pairs of a view with itself, which also contain D_v^-1, entry by entry:
    # (D^-1 + S)^2 - S^2 = D^-1 (D^-1 + 2 S).
    xp = array_namespace(marginal.shared_whitening)
    covariance, precision = marginal.shared_covariance, marginal.prior_precision.per_view
    columns_of_precisions = shared_precisions.swapaxes(-1, -2)
    shared_traces = shared_precisions @ covariance**2 @ columns_of_precisions

    weighted_gain = marginal.gain * xp.sqrt(precision)[..., None]
    *searches, view_count, _, shared_count = weighted_gain.shape
    kinds_rows = [rows_of_views(weighted_gain[..., k : k + 3, :]) for k in (0, 3)]
    rows = xp.concatenate(kinds_rows, axis=-2)
    rows_covariance = rows @ covariance
    by_kind = rows_covariance.reshape(*searches, 2, 3 * view_count, shared_count)
    cross_traces = (by_kind**2).sum(axis=-2) @ columns_of_precisions
    pair_traces = _traces_of_pairs(rows, rows_covariance)

    inverse = marginal.per_view_inverse
    excess = inverse * (2.0 * marginal.per_view_covariance - inverse)
    weighted_excess = precision[..., None] * excess * precision[..., None, :]
    own_pairs = IS_POSE_KIND @ weighted_excess.sum(axis=-3) @ IS_POSE_KIND.T
    return _arranged(pair_traces + own_pairs, cross_traces, shared_traces)


def _traces_of_pairs(
    rows: Float[AnyArray, "*searches rows shared"],
    rows_covariance: Float[AnyArray, "*searches rows shared"],
) -> Float[AnyArray, "*searches 2 2"]:
    """Return tr(N_j C_ss N_k C_ss) for translation and rotation, over all pairs of views.

    Args:
        rows: the rows R_j of N_j = R_j^T R_j, the half with translations first.
        rows_covariance: these times C_ss.
    """
    *searches, row_count, shared_count = rows.shape
    row_count //= 2
    if 2 * row_count <= shared_count:
        # The trace is the sum of the squares of R_j C_ss R_k^T.
        pairs = rows_covariance @ rows.swapaxes(-1, -2)
        pairs = pairs.reshape(*searches, 2, row_count, 2, row_count)
        return (pairs**2).sum(axis=(-3, -1))
    by_kind = (*searches, 2, row_count, shared_count)
    products = rows.reshape(by_kind).swapaxes(-1, -2) @ rows_covariance.reshape(by_kind)
    flat = (*searches, 2, shared_count**2)
    entries, transposed = products.reshape(flat), products.swapaxes(-1, -2).reshape(flat)
    return entries @ transposed.swapaxes(-1, -2)


def _arranged(
    upper_left: Float[AnyArray, "*searches m m"],
    upper_right: Float[AnyArray, "*searches m n"],
    lower_right: Float[AnyArray, "*searches n n"],
) -> Float[AnyArray, "*searches both both"]:
    """Return the symmetric matrices with these blocks."""
    # Twice as fast as `block`, which matters in evaluations that take less than a millisecond.
    xp = array_namespace(lower_right)
    return xp.concatenate(
        [
            xp.concatenate([upper_left, upper_right], axis=-1),
            xp.concatenate([upper_right.swapaxes(-1, -2), lower_right], axis=-1),
        ],
        axis=-2,
    )
