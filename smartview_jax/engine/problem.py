"""The joint fit as a least-squares problem, as residuals or as normal equations.

Both are pure functions. Any optimistix least-squares solver can minimise `residuals`;
`normal_equations` is the same problem in the block structure that the library's own solver uses.
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
"""Name of the mesh axis along which views are distributed over devices."""


class NormalEquations(eqx.Module):
    """The cost, its gradient and the Gauss-Newton matrix at a step.

    Attributes:
        cost: half the sum of squared whitened residuals, or of the loss, with priors where
            included.
        gradient: gradient of the cost.
        matrix: Gauss-Newton approximation of the Hessian, `J^T J`.
    """

    cost: Float[Array, ""]
    gradient: Step
    matrix: BlockArrow


class JointProblem(eqx.Module):
    """A least-squares problem: observations predicted through the whole chain, and priors.

    Attributes:
        parameters: the start, from which steps are taken.
        observations: points, pixels, visibility and reported poses.
        pixel_sigma: standard deviation of u and of v, px.
        free: indices of the free shared parameters.
        own_free: mask of the free parameters among each view's own six; no views where there are
            none.
        prior_mean: prior mean of every parameter's value; NaN where it is the start's.
        prior_weight: one over the prior standard deviation of every parameter; zero is no prior.
        scale: length of one unit of step, for the free shared parameters and for each view's own;
            for solvers that treat all parameters alike.
        loss: robust loss; None is least squares.
        mesh: devices over which the views are distributed; None is one device.
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
        """The indices of the free shared parameters, as an array."""
        return jnp.array(self.free, dtype=int)

    def start(self) -> Step:
        """Return the zero step."""
        return Step(jnp.zeros(len(self.free)), jnp.zeros(self.own_free.shape))

    def step(self, z: Step) -> Step:
        """Convert a scaled step of the free parameters to all parameters in their own units."""
        shared = jnp.zeros(self.parameters.shared_size)
        shared = shared.at[self.chosen].set(z.shared * self.scale.shared)
        own = jnp.where(self.own_free, z.corrections * self.scale.corrections, 0.0)
        return Step(shared, own)

    def calibration(self, z: Step) -> tuple[Calibration, Float[Array, "corrected 6"]]:
        """Return the calibration and the pose corrections at a scaled step."""
        return self.parameters.moved(self.step(z))

    def whitened(self, z: Step) -> Float[Array, "views points 2"]:
        """Compute the whitened residuals before any loss.

        They are measured minus predicted pixels over the pixel sigma, zero where a point is not
        visible.
        """
        calibration, poses = self._chain(z)
        return self._whitened(calibration, poses, self.observations)

    def _chain(self, z: Step) -> tuple[Calibration, SE3]:
        """Return the calibration and the corrected robot poses at a scaled step."""
        calibration, corrections = self.calibration(z)
        poses, error = self.observations.base_from_tool, calibration.robot_error
        if error is not None:
            poses = error.true_pose(self.observations.command)
        return calibration, poses @ SE3.exp(-corrections) if len(corrections) else poses

    def _whitened(
        self, calibration: Calibration, poses: SE3, seen: Observations
    ) -> Float[Array, "*views points 2"]:
        """Compute whitened residuals for given robot poses; `FAR_OFF` where projection fails."""
        predicted, valid = calibration.project(poses, seen.points, corrected=False)
        residual = seen.residuals(predicted, valid) / self.pixel_sigma
        lost = seen.visible & ~valid
        return jnp.where(lost[..., None], FAR_OFF, residual)

    def squares(self, z: Step) -> Float[Array, "views points"]:
        """Compute the squared length of every whitened residual.

        The views are processed one after the other, so that memory does not exceed that of the
        result.
        """
        calibration, poses = self._chain(z)

        def view(part: tuple[SE3, Observations]) -> Float[Array, "points"]:
            """Compute the squared residuals of one view."""
            pose, seen = part
            return jnp.sum(self._whitened(calibration, pose, seen) ** 2, axis=-1)

        return jax.lax.map(view, (poses, self.observations))

    def residuals(self, z: Step, _: None = None) -> tuple[Array, Array, Array]:
        """Return the residuals of the observations and of the shared and the views' own priors.

        Half their squared length is the cost.
        """
        observed = self.whitened(z)
        if self.loss is not None:
            observed = self.loss.whiten(observed)
        return observed, *self._prior_residuals(self.step(z))

    def normal_equations(self, z: Step) -> NormalEquations:
        """Return the normal equations at a step; robust losses by iterative reweighting."""
        return self._with_priors(self.step(z), self.observed(z))

    def observed(self, z: Step) -> NormalEquations:
        """Return the normal equations of the observations alone, without priors."""
        step = self.step(z)
        chain = linearise_chain(self.parameters, step, self.observations.command)
        views = self._linearised(chain)
        return NormalEquations(jnp.sum(views.cost), *self._through_chain(chain, views))

    def _linearised(self, chain: Chain) -> ViewBlocks:
        """Return every view's normal equations, each computed on the device that holds the view."""

        def blocks(camera, poses, observations, target_scale, pixel_sigma):
            """Linearise the views of one device."""
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
        """Transform the views' normal equations to the free parameters, in their units.

        The results are the gradient and the matrix of the observations alone.
        """
        # shared = sum_v S_v^T G_v S_v,  border_v = O_v^T G_v S_v,  own_v = O_v^T G_v O_v,
        # gradient = sum_v S_v^T g_v and O_v^T g_v,
        # where G_v and g_v are a view's matrix and gradient by (camera, twist), S_v the derivative
        # of these by the shared parameters, and O_v that of the twist (rows from n on) by the
        # view's own.
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
        """Return the derivative of camera and twist of each view by the shared parameters."""
        n, size = self.parameters.camera_size, self.parameters.shared_size
        count = len(chain.by_shared)
        camera = jnp.broadcast_to(jnp.eye(n, size)[None], (count, n, size))
        twist = jnp.pad(chain.by_shared, ((0, 0), (0, 0), (n, 0)))
        shared = jnp.concatenate([camera, twist], axis=1)[:, :, self.chosen]
        return shared * self.scale.shared[None, None]

    def _by_own(self, chain: Chain) -> Float[Array, "corrected 6 6"]:
        """Return the derivative of each view's twist by its own parameters.

        Columns of held parameters are zero.
        """
        moves = jnp.where(self.own_free, self.scale.corrections, 0.0)
        return chain.by_own * moves[:, None, :]

    @property
    def _own_weight(self) -> Float[Array, "corrected 6"]:
        """The inverse prior standard deviations of each view's own parameters, in their units."""
        weight = jnp.where(self.own_free, self.prior_weight.corrections, 0.0)
        return weight * self.scale.corrections

    @property
    def _own_precision(self) -> Float[Array, "corrected 6"]:
        """The prior precisions of each view's own parameters, with one for held parameters.

        A held parameter has a zero column in the Jacobian; the one keeps its equation solvable.
        """
        return jnp.where(self.own_free, self._own_weight**2, 1.0)

    def observed_by_view(
        self, z: Step
    ) -> tuple[Float[Array, "views free"], Float[Array, "views free free"]]:
        """Return every view's term of the shared parameters' gradient and matrix in `observed`."""
        chain = linearise_chain(self.parameters, self.step(z), self.observations.command)
        views, shared = self._linearised(chain), self._by_shared(chain)
        gradient = jnp.einsum("vki,vk->vi", shared, views.gradient)
        return gradient, jnp.einsum("vki,vkl,vlj->vij", shared, views.gram, shared)

    def information_by_view(self, z: Step) -> Float[Array, "views free free"]:
        """Compute every view's information matrix of the shared parameters.

        The view's own correction is marginalised. The matrices add up to the normal equations with
        the views' own parameters eliminated, except for the priors of the shared parameters.
        """
        chain = linearise_chain(self.parameters, self.step(z), self.observations.command)
        views, shared = self._linearised(chain), self._by_shared(chain)
        told = jnp.einsum("vki,vkl,vlj->vij", shared, views.gram, shared)
        if not len(self.own_free):
            return told
        # I_v = S_v^T G_v S_v - B_v^T D_v^-1 B_v, the Schur complement of a single view; D_v has the
        # prior of the view's own parameters.
        own, n = self._by_own(chain), self.parameters.camera_size
        own_transposed = jnp.swapaxes(own, 1, 2)
        border = own_transposed @ (views.gram[:, n:] @ shared)
        corner = own_transposed @ views.gram[:, n:, n:] @ own
        corner = corner + jnp.eye(6)[None] * self._own_precision[:, None]
        return told - jnp.swapaxes(border, 1, 2) @ jnp.linalg.solve(corner, border)

    def _with_priors(self, step: Step, observed: NormalEquations) -> NormalEquations:
        """Add the priors' cost, gradient and diagonal to the observations' normal equations."""
        # A prior is a residual w (x - mean) with w = 1 / std: it adds w^2 (x - mean)^2 / 2 to the
        # cost, w^2 (x - mean) to the gradient and w^2 to the diagonal.
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
        """Return the difference of every parameter from its prior mean, in its own units."""
        values, mean = self.parameters.values(), self.prior_mean.shared
        shared = step.shared + jnp.where(jnp.isnan(mean), 0.0, values - mean)
        return Step(shared, step.corrections - jnp.nan_to_num(self.prior_mean.corrections))

    def _prior_residuals(self, step: Step) -> tuple[Array, Array]:
        """Return the whitened residuals of the priors, shared and of the views' own parameters."""
        off, weight = self.off_mean(step), self.prior_weight
        return off.shared * weight.shared, off.corrections * weight.corrections


@compiled
def valid_at_start(problem: JointProblem) -> Bool[Array, "views points"]:
    """Return a mask of the points that can be projected at the start."""
    start = problem.parameters.start
    # One view after the other: projecting everything at once needs several times the data's memory.
    return jax.lax.map(
        lambda seen: start.project(seen.command, seen.points)[1], problem.observations
    )
