"""Free parameters, priors and steps, which every least-squares problem of the engine has.

A problem adds its observations: their residuals, and their normal equations.
"""

import abc
from collections.abc import Collection, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ..robot_errors import RobotError
from ..runtime.array_namespace import AnyArray, to_device_together
from ..runtime.modules import HostModule, with_fields
from .parameters import Step, host_step
from .pixel_aspect import FittedAspects
from .schur import BlockArrow

_Problem = TypeVar("_Problem", bound="AbstractProblem")
_Built = TypeVar("_Built", bound="AbstractBuiltProblem")


class NormalEquations(HostModule):
    """The cost, its gradient and the Gauss-Newton matrix at a step.

    Attributes:
        cost: half the sum of squared whitened residuals, or of the loss; with priors if included.
        gradient: gradient of the cost.
        matrix: Gauss-Newton approximation of the Hessian, `J^T J`.
    """

    cost: Float[Array, ""]
    gradient: Step
    matrix: BlockArrow


class ViewBlocks(HostModule):
    """The terms that each view, or state of a rig's robot, adds to the normal equations' matrix.

    Attributes:
        shared: by the free shared parameters.
        border: by the view's own parameters and the free shared ones; empty without corrections.
        per_view: by the view's own parameters; empty without corrections.
    """

    shared: Float[Array, "views free free"]
    border: Float[Array, "corrected 6 free"]
    per_view: Float[Array, "corrected 6 6"]


class AbstractProblem(HostModule):
    """A least-squares problem: observations, and Gaussian priors of the parameters.

    Attributes:
        free: indices of the free shared parameters; an index after the last one is padding (see
            `solver.padded`), a parameter without any effect.
        per_view_free: mask of the free parameters among each view's own six; empty without
            corrections.
        prior_mean: prior mean of every parameter's value; NaN for the start's value.
        prior_weight: one over the prior standard deviation of every parameter; zero is no prior.
        scale: length of one unit of step, for the free shared parameters and for each view's own;
            for solvers that treat all parameters alike.
        pixel_sigma: standard deviation of u and of v, px, or the unit of tracked poses' noise.
        mesh: devices over which the views are distributed; None is one device.
    """

    free: eqx.AbstractVar[Int[Array, "free"]]
    per_view_free: eqx.AbstractVar[Bool[Array, "corrected 6"]]
    prior_mean: eqx.AbstractVar[Step]
    prior_weight: eqx.AbstractVar[Step]
    scale: eqx.AbstractVar[Step]
    pixel_sigma: eqx.AbstractVar[Float[Array, ""]]
    mesh: eqx.AbstractVar[Mesh | None]

    @property
    @abc.abstractmethod
    def parameter_count(self) -> int:
        """The number of shared parameters, free or not."""

    @abc.abstractmethod
    def start_values(self) -> Float[Array, "shared"]:
        """Return the values of the shared parameters at the start."""

    @abc.abstractmethod
    def host_start_values(self) -> Float[np.ndarray, "shared"]:
        """Return `start_values`, computed with NumPy."""

    @abc.abstractmethod
    def observation_residuals(self, z: Step) -> Any:
        """Return the whitened residuals of the observations, with the robust loss."""

    @abc.abstractmethod
    def normal_equations_without_priors(self, z: Step) -> NormalEquations:
        """Return the normal equations of the observations alone, without priors."""

    @property
    @abc.abstractmethod
    def visible_count(self) -> int:
        """The number of visible points in all pictures, or of numbers of tracked poses."""

    @property
    @abc.abstractmethod
    def number_count(self) -> int:
        """The number of measured numbers: two for each visible point, and its depth if it has one.

        Of tracked poses it is the number of their coordinates.
        """

    @property
    @abc.abstractmethod
    def observation_count(self) -> int:
        """The number of observations, visible or not."""

    @property
    @abc.abstractmethod
    def has_pixels(self) -> bool:
        """Whether the observations are points in pictures."""

    @property
    @abc.abstractmethod
    def is_camera(self) -> Bool[Any, "shared"]:
        """Mask of the parameters of cameras (focal lengths, lens) among the shared ones."""

    @property
    @abc.abstractmethod
    def fitted_aspects(self) -> FittedAspects | None:
        """The cameras whose ratio of focal lengths is fitted in the place of alpha_v; or None."""

    def host_named_by_fitted(self, z: Step) -> Float[np.ndarray, "free free"] | None:
        """Return the derivative of the free parameters that have names by the fitted ones.

        They differ where a ratio of focal lengths is fitted in the place of alpha_v; None if no
        ratio is.

        Args:
            z: scaled step from the start.
        """
        aspects = self.fitted_aspects
        if aspects is None:
            return None
        values, free = np.array(self.host_start_values()), np.asarray(self.free)
        values[free] += np.asarray(self.scale.shared) * np.asarray(z.shared)
        return np.asarray(aspects.named_by_fitted(values))[np.ix_(free, free)]

    def covariance_by_names(
        self, z: Step, covariance: Float[AnyArray, "free free"]
    ) -> Float[AnyArray, "free free"]:
        """Return the covariance of the free shared parameters as they are named, in a program."""
        aspects = self.fitted_aspects
        if aspects is None:
            return covariance
        values = self.start_values() + self.unscaled_step(z).shared
        by_fitted = self._take_free(self._take_free(aspects.named_by_fitted(values)).T).T
        named = by_fitted @ covariance @ by_fitted.T
        # If nothing determines a parameter, the whole covariance is infinite, and stays so.
        converted = jnp.any(aspects.fits_aspect) & jnp.all(jnp.isfinite(covariance))
        return jnp.where(converted, named, covariance)

    def fitted_names(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of all shared parameters, with the ratios in the places of alpha_v.

        Args:
            names: their names, with alpha_v.
        """
        aspects = self.fitted_aspects
        return tuple(names) if aspects is None else aspects.fitted_names(names)

    def host_prior_information(self) -> Float[np.ndarray, "free free"]:
        """Return the information of the priors on the free shared parameters as they are named."""
        # Prior information is the square of the weight on each free parameter.
        information = np.diag(self.host_prior_weight**2)
        by_fitted = self.host_named_by_fitted(self.zero_step())
        if by_fitted is None:
            return information
        by_named = np.linalg.inv(by_fitted)
        return by_named.T @ information @ by_named

    @property
    @abc.abstractmethod
    def robot_error(self) -> RobotError | None:
        """The robot's error at the start; None without a field."""

    @abc.abstractmethod
    def chain(self, z: Step) -> Any:
        """Return the chain of every view at a scaled step."""

    @abc.abstractmethod
    def with_noise_corrections(
        self: _Problem, corrections: Float[np.ndarray, "views 6"]
    ) -> _Problem:
        """Return the problem with the robot error field at poses corrected for noise."""

    @property
    @abc.abstractmethod
    def host_correction_roots(self) -> Float[np.ndarray, "corrected 6 6"] | None:
        """The twist of each view's correction by its own six parameters.

        None if the parameters are the twist, as where poses err alike in all directions.
        """

    def host_corrections(
        self, per_view: Float[np.ndarray, "corrected 6"]
    ) -> Float[np.ndarray, "corrected 6"]:
        """Return the twists of the views' corrections, given their own parameters."""
        roots = self.host_correction_roots
        return per_view if roots is None else np.einsum("vij,vj->vi", roots, per_view)

    def with_free(self: _Problem, kept: Int[np.ndarray, "kept"]) -> _Problem:
        """Return the problem with some of its free shared parameters; the others are held."""
        shared, free = to_device_together(
            (np.asarray(self.scale.shared)[kept], np.asarray(self.free)[kept])
        )
        return with_fields(self, free=free, scale=Step(shared, self.scale.per_view))

    def zero_step(self) -> Step:
        """Return the zero step."""
        zeros = np.zeros(len(self.free)), np.zeros(self.per_view_free.shape)
        return to_device_together(host_step(*zeros))

    def unscaled_step(self, z: Step) -> Step:
        """Convert a scaled step of the free parameters to all parameters in their own units."""
        # A sum over a mask, not a scatter, which XLA makes a loop of. Padding selects nothing.
        chosen = self.free[:, None] == np.arange(self.parameter_count)[None]
        shared = jnp.sum(jnp.where(chosen, (z.shared * self.scale.shared)[:, None], 0.0), axis=0)
        per_view = jnp.where(self.per_view_free, z.per_view * self.scale.per_view, 0.0)
        return Step(shared, per_view)

    def residuals(self, z: Step, _: None = None) -> tuple[Any, Array, Array]:
        """Return the residuals of the observations and of the shared and the views' own priors.

        Half their squared length is the cost.
        """
        return self.observation_residuals(z), *self._prior_residuals(self.unscaled_step(z))

    def normal_equations(self, z: Step) -> NormalEquations:
        """Return the normal equations at a step; robust losses by iterative reweighting."""
        return self._with_priors(self.unscaled_step(z), self.normal_equations_without_priors(z))

    def without_corrections(self, blocks: ViewBlocks) -> Float[Array, "views free free"]:
        """Return every view's information matrix of the shared parameters.

        The view's own correction is marginalised. The matrices add up to the normal equations with
        the views' own parameters eliminated, except for the priors of the shared parameters.

        Args:
            blocks: what each view adds to the matrix of the normal equations, without priors.
        """
        if not len(self.per_view_free):
            return blocks.shared
        # I_v = A_v - B_v^T D_v^-1 B_v, the Schur complement of a single view; D_v has the prior of
        # the view's own parameters.
        border, prior = blocks.border, jnp.eye(6)[None] * self._per_view_precision[:, None]
        gain = jnp.linalg.solve(blocks.per_view + prior, border)
        return blocks.shared - jnp.swapaxes(border, 1, 2) @ gain

    def _take_free(self, shared: Float[Array, "*batch shared"]) -> Float[Array, "*batch free"]:
        """Return the entries of the free shared parameters, with zeros for padding."""
        return jnp.take(shared, self.free, axis=-1, mode="fill", fill_value=0.0)

    def of_free_parameters(self, equations: NormalEquations) -> NormalEquations:
        """Return the equations of all parameters for the free ones, in units of the step."""
        gradient, matrix = equations.gradient, equations.matrix
        return NormalEquations(
            equations.cost,
            Step(
                self._take_free(gradient.shared) * self.scale.shared,
                gradient.per_view * self._own_scale,
            ),
            BlockArrow(*self.by_free_parameters(matrix.shared, matrix.border, matrix.per_view)),
        )

    def by_free_parameters(
        self,
        shared: Float[Array, "*batch shared shared"],
        border: Float[Array, "corrected 6 shared"],
        per_view: Float[Array, "corrected 6 6"],
    ) -> tuple[Array, Array, Array]:
        """Return blocks of a matrix by the free parameters, in units of the step."""
        scale, own_scale = self.scale.shared, self._own_scale
        rows_taken = jnp.swapaxes(self._take_free(shared), -1, -2)
        units = scale[:, None] * scale[None]
        return (
            self._take_free(rows_taken) * units[(None,) * (shared.ndim - 2)],
            self._take_free(border) * own_scale[:, :, None] * scale[None, None],
            per_view * own_scale[:, :, None] * own_scale[:, None],
        )

    @property
    def _own_scale(self) -> Float[Array, "corrected 6"]:
        """The unit of the views' own parameters; zero for those that are held."""
        return jnp.where(self.per_view_free, self.scale.per_view, 0.0)

    @property
    def _per_view_weight(self) -> Float[Array, "corrected 6"]:
        """The inverse prior standard deviations of each view's own parameters, in their units."""
        weight = jnp.where(self.per_view_free, self.prior_weight.per_view, 0.0)
        return weight * self.scale.per_view

    @property
    def _per_view_precision(self) -> Float[Array, "corrected 6"]:
        """The prior precisions of each view's own parameters, with one for fixed parameters.

        A fixed parameter has a zero column in the Jacobian; 1 keeps the equations solvable.
        """
        return jnp.where(self.per_view_free, self._per_view_weight**2, 1.0)

    def _with_priors(self, step: Step, equations: NormalEquations) -> NormalEquations:
        """Add the priors' cost, gradient and diagonal to the observations' normal equations."""
        # A prior is a residual w (x - mean) with w = 1 / std: it adds w^2 (x - mean)^2 / 2 to the
        # cost, w^2 (x - mean) to the gradient and w^2 to the diagonal.
        gradient, matrix = equations.gradient, equations.matrix
        residual, per_view_residual = self._prior_residuals(step)
        weight = self._take_free(self.prior_weight.shared) * self.scale.shared
        # Padding has a zero column in the Jacobian; 1 keeps the equations solvable.
        precision = jnp.where(self.free < self.parameter_count, weight**2, 1.0)
        return NormalEquations(
            equations.cost + 0.5 * (jnp.sum(residual**2) + jnp.sum(per_view_residual**2)),
            Step(
                gradient.shared + weight * self._take_free(residual),
                gradient.per_view + self._per_view_weight * per_view_residual,
            ),
            BlockArrow(
                matrix.shared + jnp.diag(precision),
                matrix.border,
                matrix.per_view + jnp.eye(6)[None] * self._per_view_precision[:, None],
            ),
        )

    def offset_from_prior(self, step: Step) -> Step:
        """Return the difference of every parameter from its prior mean, in its own units."""
        values, mean = self.start_values(), self.prior_mean.shared
        shared = step.shared + jnp.where(jnp.isnan(mean), 0.0, values - mean)
        return Step(shared, step.per_view - jnp.nan_to_num(self.prior_mean.per_view))

    def host_offset_at_start(self) -> Float[np.ndarray, "shared"]:
        """Return the difference of every shared parameter's start from its prior mean.

        It is computed with NumPy, because compilation would take longer.
        """
        mean = np.asarray(self.prior_mean.shared)
        return np.where(np.isnan(mean), 0.0, self.host_start_values() - mean)

    @property
    def host_prior_weight(self) -> Float[np.ndarray, "free"]:
        """The inverse prior standard deviation of each fitted shared parameter; 0 is no prior."""
        return np.asarray(self.prior_weight.shared)[np.asarray(self.free)]

    def prior_cost(self, z: Step) -> Float[Array, ""]:
        """Return the priors' part of the cost at a scaled step."""
        shared, per_view = self._prior_residuals(self.unscaled_step(z))
        return 0.5 * (jnp.sum(shared**2) + jnp.sum(per_view**2))

    def _prior_residuals(self, step: Step) -> tuple[Array, Array]:
        """Return the whitened residuals of the priors, shared and of the views' own parameters."""
        offset, weight = self.offset_from_prior(step), self.prior_weight
        return offset.shared * weight.shared, offset.per_view * weight.per_view


class AbstractRigProblem(AbstractProblem):
    """A least-squares problem of several cameras, whose observations are points in pictures.

    Attributes:
        camera_mask: mask of the parameters of cameras (focal lengths, lens) among the shared ones.
    """

    camera_mask: eqx.AbstractVar[Bool[Array, "shared"]]

    @property
    @abc.abstractmethod
    def parts(self) -> list[Any]:
        """The problems of the arms, or of the cameras, stacked by kind."""

    @property
    def visible_count(self) -> int:
        """The number of visible points in all pictures."""
        return sum(part.visible_count for part in self.parts)

    @property
    def number_count(self) -> int:
        """The number of measured numbers, as in `AbstractProblem`."""
        return sum(part.number_count for part in self.parts)

    @property
    def observation_count(self) -> int:
        """The number of points in all pictures, visible or not."""
        return sum(part.observation_count for part in self.parts)

    @property
    def parameter_count(self) -> int:
        """The number of shared parameters, free or not."""
        return len(self.camera_mask)

    @property
    def is_camera(self) -> Bool[Array, "shared"]:
        """Mask of the parameters of cameras (focal lengths, lens) among the shared ones."""
        return self.camera_mask

    @property
    def has_pixels(self) -> bool:
        """Whether the observations are points in pictures."""
        return True


class AbstractBuiltProblem(HostModule):
    """A least-squares problem together with the names of its parameters.

    Attributes:
        problem: the problem, in the parameters' own units.
        shared_names: names of the free shared parameters.
        per_view_names: names of the free parameters of single views, in order.
    """

    problem: eqx.AbstractVar[Any]
    shared_names: eqx.AbstractVar[tuple[str, ...]]
    per_view_names: eqx.AbstractVar[tuple[str, ...]]

    def holding(self: _Built, names: Collection[str]) -> _Built:
        """Return the problem with these shared parameters held at the start."""
        kept = [k for k, name in enumerate(self.shared_names) if name not in names]
        return with_fields(
            self,
            problem=self.problem.with_free(np.array(kept, dtype=int)),
            shared_names=tuple(self.shared_names[k] for k in kept),
        )
