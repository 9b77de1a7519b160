"""The joint fit as a least-squares problem: residuals, or normal equations; pure functions.

Any optimistix least-squares solver can be set on `residuals`; `normal_equations` is the same
problem in the structured form that the library's own solver uses.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..compilation import compiled
from ..dataset import Observations
from .blocks import FAR_OFF, ViewBlocks, linearise_views
from .chain import Chain, linearise_chain
from .losses import AbstractLoss
from .parameters import Parameters, Step
from .schur import BlockArrow

VIEWS = "views"
"""Name of the mesh axis along which views are dealt out to devices."""


class NormalEquations(eqx.Module):
    """Cost, gradient and Gauss-Newton matrix at a step."""

    cost: Float[Array, ""]
    gradient: Step
    matrix: BlockArrow


class JointProblem(eqx.Module):
    """Observations through the whole chain, with priors.

    Attributes:
        parameters: the start, from which steps are taken.
        observations: points, pixels, visibility and reported poses.
        pixel_sigma: of u and of v, px.
        free: indices of the shared parameters that may move.
        own_free: which of each view's own six may move; no views where there are none.
        prior_mean: of every parameter's value; NaN where it is the start's.
        prior_weight: one over its standard deviation; zero is no prior.
        scale: length of one unit of step, of the shared parameters that are free and of each view's
            own; for solvers that treat all parameters alike.
        loss: None is least squares.
        mesh: the devices that the views are dealt out to; None is one device.
    """

    parameters: Parameters
    observations: Observations
    pixel_sigma: Float[Array, ""]
    free: tuple[int, ...] = eqx.field(static=True)
    own_free: Bool[Array, "corrected 6"]
    prior_mean: Step
    prior_weight: Step
    scale: Step
    loss: AbstractLoss | None
    mesh: Mesh | None = eqx.field(static=True, default=None)

    @property
    def chosen(self) -> Int[Array, "free"]:
        """`free` as an index."""
        return jnp.array(self.free, dtype=int)

    def start(self) -> Step:
        """The step that changes nothing."""
        return Step(jnp.zeros(len(self.free)), jnp.zeros(self.own_free.shape))

    def step(self, z: Step) -> Step:
        """The step of all parameters, in their own units, from the scaled one of the free ones."""
        shared = jnp.zeros(self.parameters.shared_size)
        shared = shared.at[self.chosen].set(z.shared * self.scale.shared)
        own = jnp.where(self.own_free, z.corrections * self.scale.corrections, 0.0)
        return Step(shared, own)

    def calibration(self, z: Step) -> tuple[Calibration, Float[Array, "corrected 6"]]:
        """Calibration and pose corrections at a scaled step."""
        return self.parameters.moved(self.step(z))

    def whitened(self, z: Step) -> Float[Array, "views points 2"]:
        """Measured minus predicted over sigma, before any loss; zero where not visible."""
        calibration, poses = self._chain(z)
        return self._whitened(calibration, poses, self.observations)

    def _chain(self, z: Step) -> tuple[Calibration, SE3]:
        """Calibration and corrected robot poses at a scaled step."""
        calibration, corrections = self.calibration(z)
        poses, error = self.observations.base_from_tool, calibration.robot_error
        if error is not None:
            poses = error.true_pose(self.observations.command)
        return calibration, poses @ SE3.exp(-corrections) if len(corrections) else poses

    def _whitened(
        self, calibration: Calibration, poses: SE3, seen: Observations
    ) -> Float[Array, "*views points 2"]:
        predicted, valid = calibration.project(poses, seen.points, corrected=False)
        residual = seen.residuals(predicted, valid) / self.pixel_sigma
        lost = seen.visible & ~valid
        return jnp.where(lost[..., None], FAR_OFF, residual)

    def squares(self, z: Step) -> Float[Array, "views points"]:
        """Squared length of `whitened`, view by view: memory stays that of the answer."""
        calibration, poses = self._chain(z)

        def view(part: tuple[SE3, Observations]) -> Float[Array, "points"]:
            pose, seen = part
            return jnp.sum(self._whitened(calibration, pose, seen) ** 2, axis=-1)

        return jax.lax.map(view, (poses, self.observations))

    def residuals(self, z: Step, _: None = None) -> tuple[Array, Array, Array]:
        """Of observations, and of both kinds of priors; half their squared length is the cost."""
        observed = self.whitened(z)
        if self.loss is not None:
            observed = self.loss.whiten(observed)
        return observed, *self._prior_residuals(self.step(z))

    def normal_equations(self, z: Step) -> NormalEquations:
        """The same problem, linearised; robust losses by iterative reweighting."""
        return self._with_priors(self.step(z), self.observed(z))

    def observed(self, z: Step) -> NormalEquations:
        """`normal_equations` of the observations alone, without priors."""
        step = self.step(z)
        chain = linearise_chain(self.parameters, step, self.observations.command)
        views = self._linearised(chain)
        return NormalEquations(jnp.sum(views.cost), *self._through_chain(chain, views))

    def _linearised(self, chain: Chain) -> ViewBlocks:
        """Every view's normal equations, each on the device that holds the view."""

        def blocks(camera, poses, observations, target_scale, pixel_sigma):
            return linearise_views(
                camera, poses, observations, target_scale, pixel_sigma, self.loss
            )

        if self.mesh is not None:
            per_view = (P(), P(VIEWS), P(VIEWS), P(), P())
            blocks = jax.shard_map(
                blocks, mesh=self.mesh, in_specs=per_view, out_specs=P(VIEWS), check_vma=False
            )
        calibration = chain.calibration
        return blocks(
            calibration.camera,
            chain.camera_from_world,
            self.observations,
            calibration.target_scale,
            self.pixel_sigma,
        )

    def _through_chain(self, chain: Chain, views: ViewBlocks) -> tuple[Step, BlockArrow]:
        """Gradient and matrix of the observations alone, by the free parameters in their units."""
        shared, n, count = self._by_shared(chain), self.parameters.camera_size, len(views.cost)
        gram_shared = views.gram @ shared
        matrix = jnp.einsum("vki,vkj->ij", shared, gram_shared)
        gradient = jnp.einsum("vki,vk->i", shared, views.gradient)

        own = self._by_own(chain)
        seen = slice(count if len(own) else 0)
        own_transposed = jnp.swapaxes(own, 1, 2)
        border = own_transposed @ gram_shared[seen, n:]
        corner = own_transposed @ views.gram[seen, n:, n:] @ own
        own_gradient = jnp.einsum("vki,vk->vi", own, views.gradient[seen, n:])
        return Step(gradient, own_gradient), BlockArrow(matrix, border, corner)

    def _by_shared(self, chain: Chain) -> Float[Array, "views columns free"]:
        """How the camera's numbers and each view's twist follow from the shared parameters."""
        n, size = self.parameters.camera_size, self.parameters.shared_size
        count = len(chain.by_shared)
        camera = jnp.broadcast_to(jnp.eye(n, size)[None], (count, n, size))
        twist = jnp.pad(chain.by_shared, ((0, 0), (0, 0), (n, 0)))
        shared = jnp.concatenate([camera, twist], axis=1)[:, :, self.chosen]
        return shared * self.scale.shared[None, None]

    def _by_own(self, chain: Chain) -> Float[Array, "corrected 6 6"]:
        """How each view's twist follows from its own numbers; no column for what is held."""
        moves = jnp.where(self.own_free, self.scale.corrections, 0.0)
        return chain.by_own * moves[:, None, :]

    @property
    def _own_weight(self) -> Float[Array, "corrected 6"]:
        """One over the deviation of each view's own numbers, in their units."""
        weight = jnp.where(self.own_free, self.prior_weight.corrections, 0.0)
        return weight * self.scale.corrections

    @property
    def _own_precision(self) -> Float[Array, "corrected 6"]:
        """A number that is held has no column: a one keeps its equation solvable."""
        return jnp.where(self.own_free, self._own_weight**2, 1.0)

    def observed_by_view(
        self, z: Step
    ) -> tuple[Float[Array, "views free"], Float[Array, "views free free"]]:
        """Every view's part of the shared parameters' gradient and matrix in `observed`."""
        chain = linearise_chain(self.parameters, self.step(z), self.observations.command)
        views, shared = self._linearised(chain), self._by_shared(chain)
        gradient = jnp.einsum("vki,vk->vi", shared, views.gradient)
        return gradient, jnp.einsum("vki,vkl,vlj->vij", shared, views.gram, shared)

    def information_by_view(self, z: Step) -> Float[Array, "views free free"]:
        """What every view tells of the shared parameters, its own correction integrated out.

        They add up to the normal equations with the views' own numbers eliminated, but for the
        priors of the shared parameters.
        """
        chain = linearise_chain(self.parameters, self.step(z), self.observations.command)
        views, shared = self._linearised(chain), self._by_shared(chain)
        told = jnp.einsum("vki,vkl,vlj->vij", shared, views.gram, shared)
        if not len(self.own_free):
            return told
        own, n = self._by_own(chain), self.parameters.camera_size
        own_transposed = jnp.swapaxes(own, 1, 2)
        border = own_transposed @ (views.gram[:, n:] @ shared)
        corner = own_transposed @ views.gram[:, n:, n:] @ own
        corner = corner + jnp.eye(6)[None] * self._own_precision[:, None]
        return told - jnp.swapaxes(border, 1, 2) @ jnp.linalg.solve(corner, border)

    def _with_priors(self, step: Step, observed: NormalEquations) -> NormalEquations:
        chosen, gradient, matrix = self.chosen, observed.gradient, observed.matrix
        residual, own_residual = self._prior_residuals(step)
        weight = self.prior_weight.shared[chosen] * self.scale.shared
        return NormalEquations(
            observed.cost + 0.5 * (jnp.sum(residual**2) + jnp.sum(own_residual**2)),
            Step(
                gradient.shared + weight * residual[chosen],
                gradient.corrections + self._own_weight * own_residual,
            ),
            BlockArrow(
                matrix.shared + jnp.diag(weight**2),
                matrix.border,
                matrix.own + jnp.eye(6)[None] * self._own_precision[:, None],
            ),
        )

    def off_mean(self, step: Step) -> Step:
        """How far every parameter is from the mean of its prior, in its own units."""
        values, mean = self.parameters.values(), self.prior_mean.shared
        shared = step.shared + jnp.where(jnp.isnan(mean), 0.0, values - mean)
        return Step(shared, step.corrections - jnp.nan_to_num(self.prior_mean.corrections))

    def _prior_residuals(self, step: Step) -> tuple[Array, Array]:
        off, weight = self.off_mean(step), self.prior_weight
        return off.shared * weight.shared, off.corrections * weight.corrections


@compiled
def valid_at_start(problem: JointProblem) -> Bool[Array, "views points"]:
    """Which points the start can project at all."""
    start = problem.parameters.start
    # View by view: a projection of everything at once takes several times the data's memory.
    return jax.lax.map(
        lambda seen: start.project(seen.command, seen.points)[1], problem.observations
    )
