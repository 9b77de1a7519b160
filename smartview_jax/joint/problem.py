"""The joint fit as a least-squares problem: a residual vector, a pure function of pytrees.

Any optimistix least-squares solver can be set on `residuals`. The step is in units in which every
column of the Jacobian at the start has length one, so one unit of a parameter changes the cost by
about one half: solvers that treat all parameters alike then do so rightly.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..dataset import Observations
from .losses import AbstractLoss
from .parameters import Parameters

FAR_OFF = 1e3
"""Whitened residual of a point that cannot be projected: never cheaper than one that can."""


class JointProblem(eqx.Module):
    """Observations through the whole chain, with priors.

    Attributes:
        parameters: the start, from which steps are taken.
        observations: points, pixels, visibility and reported poses.
        pixel_sigma: of u and of v, px.
        free: indices of the parameters that may move.
        prior_mean, prior_weight: of every parameter's value, and one over its standard deviation;
            weight zero is no prior.
        scale: length of one unit of step, for every free parameter.
        loss: None is least squares.
    """

    parameters: Parameters
    observations: Observations
    pixel_sigma: Float[Array, ""]
    free: tuple[int, ...] = eqx.field(static=True)
    prior_mean: Float[Array, "parameters"]
    prior_weight: Float[Array, "parameters"]
    scale: Float[Array, "free"]
    loss: AbstractLoss | None

    def step(self, z: Float[Array, "free"]) -> Float[Array, "parameters"]:
        """All parameters' step from the scaled step of the free ones."""
        nothing = jnp.zeros(self.prior_mean.shape)
        return nothing.at[jnp.array(self.free, dtype=int)].set(z * self.scale)

    def calibration(self, z: Float[Array, "free"]) -> tuple[Calibration, Float[Array, "views 6"]]:
        """Calibration and pose corrections at a scaled step."""
        return self.parameters.moved(self.step(z))

    def whitened(self, z: Float[Array, "free"]) -> Float[Array, "views points 2"]:
        """Measured minus predicted over sigma, before any loss; zero where not visible."""
        calibration, corrections = self.calibration(z)
        poses = self.observations.base_from_tool
        if len(corrections):
            poses = poses @ SE3.exp(-corrections)
        predicted, valid = calibration.project(poses, self.observations.points)
        residual = self.observations.residuals(predicted, valid) / self.pixel_sigma
        lost = self.observations.visible & ~valid
        return jnp.where(lost[..., None], FAR_OFF, residual)

    def residuals(self, z: Float[Array, "free"], _: None = None) -> Float[Array, "rows"]:
        """Observations, then priors; half its squared length is the cost."""
        observed = self.whitened(z)
        if self.loss is not None:
            observed = self.loss.whiten(observed)
        value = self._values() + self.step(z)
        priors = (value - self.prior_mean) * self.prior_weight
        return jnp.concatenate([observed.ravel(), priors])

    def jacobian(self, z: Float[Array, "free"]) -> Float[Array, "rows free"]:
        return jax.jacfwd(self.residuals)(z)

    def _values(self) -> Float[Array, "parameters"]:
        shared = self.parameters.values()
        return jnp.concatenate([shared, jnp.zeros(len(self.prior_mean) - len(shared))])


def valid_at_start(problem: JointProblem) -> Bool[Array, "views points"]:
    """Which points the start can project at all."""
    return problem.parameters.start.project(
        problem.observations.base_from_tool, problem.observations.points
    )[1]
