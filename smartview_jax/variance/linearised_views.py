"""The views as a linear and Gaussian model, which the restricted likelihood is computed from."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..engine import BlockArrow, Step
from ..runtime.array_namespace import AnyArray, AnyScalar, array_namespace
from ..runtime.modules import with_fields
from .standard_deviations import ROBOT_SIGMA_FLOOR, AnyScalars


class LinearisedViews(NamedTuple):
    """The observations' normal equations for a pixel sigma of 1 px, and the layout of the priors.

    Several searches that hold different parameters have views in common: see
    `with_held_in_searches`.

    Attributes:
        matrix: normal equations of the free shared parameters and each view's own, without priors.
        gradient: gradient of half the sum of squared residuals.
        residual_sum_of_squares: sum of squared residuals at the linearisation minus the sum at the
            fit with free poses and a free camera, px^2.
        offset_from_prior: difference of the parameters from their prior means at the linearisation.
        known_weight: one over the standard deviation of the priors with known standard deviations.
        group_index: index of the group of unknown standard deviation of each shared parameter, -1
            for none.
        per_view_free: mask of the free parameters among each view's own six.
        statistic_count: number of statistics: free parameters of the camera, and of the views' own
            poses.
        white_sigma: standard deviation of the noise within views, px.
    """

    matrix: BlockArrow
    gradient: Step
    residual_sum_of_squares: AnyScalars
    offset_from_prior: Step
    known_weight: Float[AnyArray, "*searches shared"]
    group_index: Int[AnyArray, "*searches shared"]
    per_view_free: Bool[AnyArray, "views 6"]
    statistic_count: AnyScalar
    white_sigma: AnyScalar

    def with_held(self, held: Bool[AnyArray, "shared"]) -> "LinearisedViews":
        """Return the views with some shared parameters held at their prior means, and left out."""
        # The change to the prior mean is d = -offset for the held parameters (index h):
        #     g -> g + M_h d,   R -> R + 2 g_h^T d + d^T M_hh d
        kept, matrix, gradient = ~held, self.matrix, self.gradient
        change = -self.offset_from_prior.shared[held]
        gradient_change = matrix.shared[:, held] @ change
        return self._replace(
            matrix=with_fields(
                matrix, shared=matrix.shared[kept][:, kept], border=matrix.border[:, :, kept]
            ),
            gradient=Step(
                (gradient.shared + gradient_change)[kept],
                gradient.per_view + matrix.border[:, :, held] @ change,
            ),
            residual_sum_of_squares=self.residual_sum_of_squares
            + (2.0 * gradient.shared + gradient_change)[held] @ change,
            offset_from_prior=Step(
                self.offset_from_prior.shared[kept], self.offset_from_prior.per_view
            ),
            known_weight=self.known_weight[kept],
            group_index=self.group_index[kept],
        )

    def with_held_in_searches(self, held: Bool[np.ndarray, "searches shared"]) -> "LinearisedViews":
        """Return the views with other shared parameters held in each of several searches.

        Arrays that differ between the searches get these as their first axis. Parameters that all
        searches hold are left out. One that a single search holds stays, known by its prior
        alone, so that it contributes nothing: no information, no offset, and a prior with a known
        standard deviation of one.

        Args:
            held: mask of the parameters to hold at their prior means.
        """
        is_unused = np.asarray(held.all(axis=0))
        views, held = self.with_held(is_unused), held[:, ~is_unused]
        if not held.any():
            return views
        matrix, gradient = views.matrix, views.gradient
        # As in `with_held`, with d = 0 for the parameters that are not held.
        change = np.where(held, -views.offset_from_prior.shared, 0.0)
        gradient_change = change @ matrix.shared
        border_change = change @ rows_of_views(matrix.border).T
        growth = np.vecdot(2.0 * gradient.shared + gradient_change, change)
        is_off = held[:, :, None] | held[:, None, :]
        return views._replace(
            matrix=with_fields(
                matrix,
                shared=np.where(is_off, 0.0, matrix.shared),
                border=np.where(held[:, None, None], 0.0, matrix.border),
            ),
            gradient=Step(
                np.where(held, 0.0, gradient.shared + gradient_change),  # pyright: ignore[reportArgumentType]
                gradient.per_view + border_change.reshape(-1, *gradient.per_view.shape),
            ),
            residual_sum_of_squares=views.residual_sum_of_squares + growth,
            offset_from_prior=Step(
                np.where(held, 0.0, views.offset_from_prior.shared),  # pyright: ignore[reportArgumentType]
                views.offset_from_prior.per_view,
            ),
            known_weight=np.where(held, 1.0, views.known_weight),
            group_index=np.where(held, -1, views.group_index),
        )

    def about_common(
        self,
        coefficients: Int[np.ndarray, "coefficients"],
        mean: Float[np.ndarray, "coefficients"],
        root: Float[np.ndarray, "coefficients uncertain"],
    ) -> "LinearisedViews":
        """Return the views with prior means of some parameters, known to a covariance `R R^T`.

        The parameters are mean + R u + e. Those with the given indices become e, and the u, with a
        known prior of variance one, come last.

        Args:
            coefficients: indices of the parameters.
            mean: their prior means.
            root: a matrix R.
        """
        matrix, gradient, count = self.matrix, self.gradient, root.shape[1]
        offset = np.array(self.offset_from_prior.shared)
        by_common = np.zeros((len(offset), count))
        by_common[coefficients] = root
        whole = np.concatenate([np.eye(len(offset)), by_common], axis=1)
        # The linearisation stays where it is, with u = 0.
        offset[coefficients] -= mean
        return self._replace(
            matrix=with_fields(
                matrix, shared=whole.T @ matrix.shared @ whole, border=matrix.border @ whole
            ),
            gradient=Step(gradient.shared @ whole, gradient.per_view),
            offset_from_prior=Step(
                np.append(offset, np.zeros(count)),  # pyright: ignore[reportArgumentType]
                self.offset_from_prior.per_view,
            ),
            known_weight=np.append(self.known_weight, np.ones(count)),
            group_index=np.append(self.group_index, np.full(count, -1)),
        )

    def without_common(
        self,
        coefficients: Int[np.ndarray, "coefficients"],
        common: Int[np.ndarray, "uncertain"],
        mean: Float[np.ndarray, "coefficients"],
        root: Float[np.ndarray, "coefficients uncertain"],
    ) -> "LinearisedViews":
        """Return the views with the whole parameters about zero; the reverse of `about_common`.

        Args:
            coefficients, mean, root: as of `about_common`.
            common: indices of the u.
        """
        offset = np.array(self.offset_from_prior.shared)
        offset[coefficients] += mean + root @ offset[common]
        kept = np.setdiff1d(np.arange(len(offset)), common)
        matrix, index = self.matrix, self.group_index[kept]
        removed = self.group_index[common][:1]
        return self._replace(
            matrix=with_fields(
                matrix, shared=matrix.shared[np.ix_(kept, kept)], border=matrix.border[:, :, kept]
            ),
            gradient=Step(self.gradient.shared[kept], self.gradient.per_view),
            offset_from_prior=Step(
                offset[kept],  # pyright: ignore[reportArgumentType]
                self.offset_from_prior.per_view,
            ),
            known_weight=self.known_weight[kept],
            group_index=index - (index > removed) if (removed >= 0).any() else index,
        )

    def in_own_axes(self, roots: Float[np.ndarray, "views 6 6"]) -> "LinearisedViews":
        """Return the views with other own parameters: the present ones are `roots` times these."""
        matrix, transposed = self.matrix, roots.swapaxes(1, 2)
        offset = self.offset_from_prior
        return self._replace(
            matrix=with_fields(
                matrix,
                border=transposed @ matrix.border,
                per_view=transposed @ matrix.per_view @ roots,
            ),
            gradient=self.gradient._replace(
                per_view=(transposed @ self.gradient.per_view[..., None])[..., 0]
            ),
            offset_from_prior=offset._replace(
                per_view=np.linalg.solve(roots, offset.per_view[..., None])[..., 0]
            ),
        )

    def lower_bounds(self, component_count: int) -> Float[AnyArray, "kinds"]:
        """Return all lower bounds, in the order of `StandardDeviations.vector`."""
        xp = array_namespace(self.white_sigma)
        white_sigma = xp.reshape(xp.asarray(self.white_sigma), 1)
        return xp.concatenate([white_sigma, xp.full(component_count - 1, ROBOT_SIGMA_FLOOR)])


def rows_of_views(
    blocks: Float[AnyArray, "*searches views own columns"],
) -> Float[AnyArray, "*searches rows columns"]:
    """Return the blocks of all views one below the other, as a single matrix."""
    *searches, views, size, columns = blocks.shape
    return blocks.reshape(*searches, views * size, columns)


class Kinds(NamedTuple):
    """The kinds of random numbers: each kind has one unknown standard deviation.

    Attributes:
        groups: one where a shared parameter belongs to a group of the field, zero elsewhere.
        counts: number of random numbers of each kind, in the order of `StandardDeviations.vector`.
    """

    groups: Float[AnyArray, "*searches groups shared"]
    counts: Float[AnyArray, "*searches kinds"]


def kinds_of(views: LinearisedViews, groups: int) -> Kinds:
    """Return the kind of each random number of the views, given the number of groups."""
    xp = array_namespace(views.group_index)
    index = views.group_index
    indicator = (index[..., None, :] == xp.arange(groups)[:, None]).astype(float)
    robot = xp.sum(views.per_view_free.reshape(-1, 2, 3), axis=(0, 2), dtype=float)
    statistics = xp.reshape(xp.asarray(views.statistic_count), 1)
    of_all = xp.broadcast_to(xp.concatenate([statistics, robot]), (*index.shape[:-1], 3))
    return Kinds(indicator, xp.concatenate([of_all, xp.sum(indicator, axis=-1)], axis=-1))
