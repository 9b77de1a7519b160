"""The joint fit as a least-squares problem, as residuals or as normal equations.

Both are pure functions. Any optimistix least-squares solver can minimise `residuals`;
`normal_equations` is the same problem in the block structure that the library's own solver uses.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration, TargetShape, chain_of_matrices
from ..dataset import AnyObservations, Observations, PoseObservations
from ..geometry import host_logarithms, moved_points, pose_matrices, transforms_of
from ..robot_errors import RobotError
from ..robots import Command
from ..runtime.array_namespace import AnyArray
from ..runtime.modules import HostModule, with_fields
from .abstract_problem import AbstractProblem, NormalEquations, ViewBlocks
from .depth_equations import DepthEquations, depth_residuals, linearise_depths
from .losses import AbstractLoss
from .parameters import DEPTH_BIAS_NAMES, Parameters, Step
from .pixel_aspect import FittedAspects
from .pose_jacobians import PoseJacobians, corrections_at_tool, linearise_poses
from .prepared_poses import PreparedPoses, prepare_poses
from .schur import BlockArrow
from .tracked_poses import linearise_tracked_poses
from .view_normal_equations import INVALID_PROJECTION_RESIDUAL, ViewNormalEquations, linearise_views

VIEW_AXIS = "views"
"""The name of the mesh axis along which views are distributed over devices."""


_DIRECT, _TWIST = slice(0, -6), slice(-6, None)
"""Rows of a view's normal equations: of camera and shape, and of the twist of its pose."""


class FittedChain(HostModule):
    """The chain of transforms of every view at a step.

    Attributes:
        calibration: the calibration.
        pose_corrections: twist at the tool of every view's own correction; empty without
            corrections.
        field_errors: motion of the tool, as a 4x4 matrix, from the reported pose to the pose
            corrected by the robot error field; the identity without a field.
        camera_from_world: pose of the world in each view's camera, with all corrections.
    """

    calibration: Calibration
    pose_corrections: Float[AnyArray, "corrected 6"]
    field_errors: Float[AnyArray, "*views 4 4"]
    camera_from_world: Float[AnyArray, "*views 4 4"]

    @property
    def field_corrections(self) -> Float[np.ndarray, "*views 6"]:
        """The twists of `field_errors`, translation (m) first, computed with NumPy."""
        return host_logarithms(np.asarray(self.field_errors))


class JointProblem(AbstractProblem):
    """A least-squares problem: observations predicted through the chain of transforms, and priors.

    Attributes:
        parameters: the start, from which steps are taken.
        observations: points, pixels, visibility and reported poses.
        pixel_sigma: standard deviation of u and of v, px.
        free, per_view_free, prior_mean, prior_weight, scale, mesh: as in `AbstractProblem`.
        loss: robust loss; None is least squares.
        prepared_poses: precomputed quantities of the robot error field; None without a field.
        correction_roots: the twist of each view's correction by its own six parameters, where the
            errors of poses differ by direction; None if the parameters are the twist.
    """

    parameters: Parameters
    observations: AnyObservations
    pixel_sigma: Float[Array, ""]
    free: Int[Array, "free"]
    per_view_free: Bool[Array, "corrected 6"]
    prior_mean: Step
    prior_weight: Step
    scale: Step
    loss: AbstractLoss | None
    prepared_poses: PreparedPoses | None = None
    correction_roots: Float[AnyArray, "corrected 6 6"] | None = None
    mesh: Mesh | None = eqx.field(static=True, default=None)

    @property
    def seen_points(self) -> Observations:
        """The points in pictures that are fitted.

        Raises:
            TypeError: the problem is fitted to tracked poses.
        """
        if isinstance(self.observations, PoseObservations):
            raise TypeError("expected points in pictures, found tracked poses")
        return self.observations

    def with_observations(self, observations: AnyObservations) -> "JointProblem":
        """Return the problem with other observations, of the same robot."""
        error = self.parameters.start.robot_error
        prepared = None if error is None else PreparedPoses.at(error.field, observations.command)
        return with_fields(self, observations=observations, prepared_poses=prepared)

    def with_noise_corrections(self, corrections: Float[np.ndarray, "views 6"]) -> "JointProblem":
        """Return the problem with the robot error field at poses corrected for noise."""
        error, command = self.parameters.start.robot_error, self.observations.command
        return with_fields(self, prepared_poses=prepare_poses(error, command, corrections))

    def with_correction_roots(
        self, roots: Float[np.ndarray, "corrected 6 6"] | None
    ) -> "JointProblem":
        """Return the problem with other axes of the views' own parameters; None for the twist."""
        return with_fields(self, correction_roots=roots)

    @property
    def host_correction_roots(self) -> Float[np.ndarray, "corrected 6 6"] | None:
        """The roots of the corrections as a NumPy array, as in `AbstractProblem`."""
        return None if self.correction_roots is None else np.asarray(self.correction_roots)

    @property
    def visible_count(self) -> int:
        """The number of visible points in all pictures, or of numbers of tracked poses."""
        return int(np.asarray(self.observations.visible).sum())

    @property
    def number_count(self) -> int:
        """The number of measured numbers, as in `AbstractProblem`."""
        depths = self.seen_points.depths if self.has_depths else None
        if depths is None:
            return 2 * self.visible_count
        used = np.asarray(depths.used) & np.asarray(self.observations.visible)
        return 2 * self.visible_count + int(used.sum())

    @property
    def observation_count(self) -> int:
        """The number of observations, visible or not."""
        return self.observations.visible.size

    @property
    def has_pixels(self) -> bool:
        """Whether the observations are points in pictures."""
        return not isinstance(self.observations, PoseObservations)

    @property
    def command(self) -> Command:
        """The command that the robot reported in each view."""
        return self.observations.command

    @property
    def robot_error(self) -> RobotError | None:
        """The robot's error at the start; None without a field."""
        return self.parameters.start.robot_error

    @property
    def parameter_count(self) -> int:
        """The number of shared parameters, free or not."""
        return self.parameters.layout.size

    @property
    def fitted_aspects(self) -> FittedAspects | None:
        """Whether the ratio of the camera's focal lengths is fitted in the place of alpha_v."""
        fits = self.parameters.fits_aspect
        return None if fits is None else FittedAspects(np.arange(2)[None], fits[None])

    @property
    def is_camera(self) -> Bool[np.ndarray, "shared"]:
        """Mask of the parameters of the camera and of its depths among the shared ones."""
        layout, index = self.parameters.layout, np.arange(self.parameter_count)
        is_bias = (index >= layout.depth_bias.start) & (index < layout.depth_bias.stop)
        return (index < layout.camera.stop) | is_bias

    def start_values(self) -> Float[Array, "shared"]:
        """Return the values of the shared parameters at the start."""
        return self.parameters.values()

    def host_start_values(self) -> Float[np.ndarray, "shared"]:
        """Return `start_values`, computed with NumPy."""
        return self.parameters.values(np)

    def calibration(self, z: Step) -> tuple[Calibration, Float[Array, "corrected 6"]]:
        """Return the calibration and the pose corrections at a scaled step."""
        return self.parameters.retract(self._twist_step(z))

    def _twist_step(self, z: Step) -> Step:
        """Return a scaled step in the parameters' own units, with corrections as twists."""
        step = self.unscaled_step(z)
        if self.correction_roots is None:
            return step
        return Step(step.shared, jnp.einsum("vij,vj->vi", self.correction_roots, step.per_view))

    def chain(self, z: Step) -> FittedChain:
        """Return the chain of every view at a scaled step."""
        calibration, pose_corrections = self.calibration(z)
        field_errors = self._field_errors(calibration)
        if field_errors is None:
            views = len(self.observations.visible)
            field_errors = jnp.broadcast_to(jnp.asarray(np.eye(4)), (views, 4, 4))
        return FittedChain(
            calibration,
            pose_corrections,
            field_errors,
            self._camera_poses(calibration, pose_corrections),
        )

    def _field_errors(self, calibration: Calibration) -> Float[Array, "views 4 4"] | None:
        """Return the robot's errors at the tool by its field; None without a field."""
        error = calibration.robot_error
        if error is None or self.prepared_poses is None:
            return None
        return self.prepared_poses.error(error.field, error.coefficients)

    def whitened_residuals(self, z: Step) -> Float[Array, "views points 2"]:
        """Compute the whitened residuals before any loss.

        They are measured minus predicted pixels over the pixel sigma, zero where a point is not
        visible.
        """
        calibration, corrections = self.calibration(z)
        poses = self._camera_poses(calibration, corrections)
        return self._whitened_residuals_at(calibration, poses, self.observations)

    def _camera_poses(
        self, calibration: Calibration, corrections: Float[Array, "corrected 6"]
    ) -> Float[Array, "views 4 4"]:
        """Return `camera_from_world` of every view, with all corrections of the robot's poses."""
        command = self.observations.command
        poses = pose_matrices(calibration.with_bases(command).base_from_tool)
        if len(corrections):
            poses = poses @ corrections_at_tool(command, -corrections)
        field_errors = self._field_errors(calibration)
        if field_errors is not None:
            poses = poses @ field_errors
        return chain_of_matrices(
            calibration.camera_from_mount, calibration.holder_from_world, calibration.mount, poses
        )

    def _whitened_residuals_at(
        self,
        calibration: Calibration,
        camera_from_world: Float[Array, "*views 4 4"],
        observations: AnyObservations,
    ) -> Float[Array, "*views points 2"]:
        """Compute whitened residuals for given poses of the camera.

        They are `INVALID_PROJECTION_RESIDUAL` where a visible point cannot be projected.
        """
        if isinstance(observations, PoseObservations):
            predicted = transforms_of(camera_from_world)
            return observations.residuals(predicted, calibration.target_scale) / self.pixel_sigma
        points = moved_points(camera_from_world, calibration.true_points(observations.points))
        predicted, valid = calibration.camera.project(points)
        residual = observations.residuals(predicted, valid) / self.pixel_sigma
        unprojectable = observations.visible & ~valid
        return jnp.where(unprojectable[..., None], INVALID_PROJECTION_RESIDUAL, residual)

    def squared_residuals(self, z: Step) -> Float[Array, "views points"]:
        """Compute the squared length of every whitened residual.

        The views are processed one after the other, so that little more memory is needed than for
        the result.
        """
        calibration, corrections = self.calibration(z)
        poses = self._camera_poses(calibration, corrections)

        def view(pose_and_observations: tuple[Array, Observations]) -> Float[Array, "points"]:
            """Compute the squared residuals of one view."""
            pose, observations = pose_and_observations
            return jnp.sum(
                self._whitened_residuals_at(calibration, pose, observations) ** 2, axis=-1
            )

        return jax.lax.map(view, (poses, self.observations))

    def observation_residuals(self, z: Step) -> Any:
        """Return the whitened residuals of the pixels, with the robust loss, and of depths."""
        residuals = self.whitened_residuals(z)
        residuals = residuals if self.loss is None else self.loss.robustify(residuals)
        if not self.has_depths:
            return residuals
        calibration, corrections = self.calibration(z)
        camera_from_world = self._camera_poses(calibration, corrections)
        return residuals, depth_residuals(
            calibration, camera_from_world, self.seen_points, self.pixel_sigma
        )

    @property
    def has_depths(self) -> bool:
        """Whether depths were measured at the points."""
        return getattr(self.observations, "depths", None) is not None

    def normal_equations_without_priors(
        self, z: Step, shape: TargetShape | None = None
    ) -> NormalEquations:
        """Return the normal equations of the observations alone, without priors.

        Args:
            z: step from the start.
            shape: shape of the target, by which the observations' points are displaced already; its
                coefficients become parameters after the free shared ones. None holds it.
        """
        pose_jacobians = self._linearise_poses(z)
        views = self._view_normal_equations(pose_jacobians, shape)
        equations = NormalEquations(
            jnp.sum(views.cost), *self._apply_chain_rule(pose_jacobians, views)
        )
        if not self.has_depths:
            return equations
        return self._depth_equations(pose_jacobians, shape).added_to(equations)

    def _depth_equations(
        self, pose_jacobians: PoseJacobians, shape: TargetShape | None = None
    ) -> DepthEquations:
        """Return what the depths of every view add to the normal equations."""
        calibration, layout = pose_jacobians.calibration, self.parameters.layout
        matrix, gradient, cost = linearise_depths(
            calibration,
            pose_jacobians.camera_from_world,
            self.seen_points,
            self.pixel_sigma,
            shape,
        )
        bends = 0 if shape is None else len(shape.coefficients)
        twist = self._shared_jacobian(pose_jacobians)[:, _TWIST]
        # Bias and scale are shared parameters themselves; the shape's coefficients come after them.
        bias = len(DEPTH_BIAS_NAMES)
        direct = np.zeros((bias + 1, layout.size))
        direct[:bias, layout.depth_bias] = np.eye(bias)
        direct[bias, layout.target_scale] = 1.0
        taken = self._take_free(jnp.asarray(direct)) * self.scale.shared[None]
        upper = jnp.pad(taken, ((0, bends), (0, bends)))
        upper = upper.at[bias + 1 :, len(self.free) :].set(jnp.eye(bends))
        by_parameters = jnp.concatenate(
            [
                jnp.broadcast_to(upper[None], (len(cost), *upper.shape)),
                jnp.pad(twist, ((0, 0), (0, 0), (0, bends))),
            ],
            axis=1,
        )
        return DepthEquations(
            matrix, gradient, cost, by_parameters, self._per_view_jacobian(pose_jacobians)
        )

    def _linearise_poses(self, z: Step) -> PoseJacobians:
        """Return the pose of the camera in every view at a scaled step, with its derivatives."""
        return linearise_poses(
            self.parameters,
            self._twist_step(z),
            self.observations.command,
            self.prepared_poses,
            on_devices=self.mesh is not None,
        )

    def _view_normal_equations(
        self, pose_jacobians: PoseJacobians, shape: TargetShape | None = None
    ) -> ViewNormalEquations:
        """Return every view's normal equations, each computed on the device that holds the view."""

        def linearise_local_views(camera, poses, observations, target_scale, pixel_sigma):
            """Linearise the views of one device."""
            if isinstance(observations, PoseObservations):
                count = self.parameters.layout.camera.stop
                return linearise_tracked_poses(
                    poses, observations, target_scale, pixel_sigma, count
                )
            return linearise_views(
                camera, poses, observations, target_scale, pixel_sigma, self.loss, shape
            )

        if self.mesh is not None:
            in_specs = (P(), P(VIEW_AXIS), P(VIEW_AXIS), P(), P())
            linearise_local_views = jax.shard_map(
                linearise_local_views,
                mesh=self.mesh,
                in_specs=in_specs,
                out_specs=P(VIEW_AXIS),
                check_vma=False,
            )
        calibration = pose_jacobians.calibration
        camera, fits_aspect = calibration.camera, self.parameters.fits_aspect
        views = linearise_local_views(
            camera,
            pose_jacobians.camera_from_world,
            self.observations,
            calibration.target_scale,
            self.pixel_sigma,
        )
        if fits_aspect is None:
            return views
        return views.by_aspect(camera.alpha_u, camera.alpha_v, fits_aspect)

    def _apply_chain_rule(
        self, pose_jacobians: PoseJacobians, views: ViewNormalEquations
    ) -> tuple[Step, BlockArrow]:
        """Transform the views' normal equations to the free parameters, in their units.

        The results are the gradient and the matrix of the observations alone.
        """
        # A view's matrix G_v and gradient g_v have rows for the direct parameters (d: camera and
        # shape) and for the twist (t). All other shared parameters act through the twist, with
        # T_v = PoseJacobians.shared_jacobian, and the view's own with O_v = per_view:
        #
        # matrix = sum_v [[G_dd, G_dt T], [T^T G_td, T^T G_tt T]],  gradient = sum_v [g_d, T^T g_t]
        # border_v = O^T [G_td, G_tt T],  per_view_block_v = O^T G_tt O
        chained = pose_jacobians.shared_jacobian
        by_direct, by_twist = views.matrix[:, _TWIST, _DIRECT], views.matrix[:, _TWIST, _TWIST]
        twist_rows = jnp.concatenate([by_direct, by_twist @ chained], axis=2)
        chained_rows = jnp.einsum("vki,vkj->ij", chained, twist_rows)
        count = by_direct.shape[2]
        direct_rows = jnp.concatenate(
            [jnp.sum(views.matrix[:, _DIRECT, _DIRECT], axis=0), chained_rows[:, :count].T], axis=1
        )
        matrix = jnp.concatenate([direct_rows, chained_rows])
        twist_gradient = views.gradient[:, _TWIST]
        gradient = jnp.concatenate(
            [
                jnp.sum(views.gradient[:, _DIRECT], axis=0),
                jnp.einsum("vki,vk->i", chained, twist_gradient),
            ]
        )
        per_view, border, per_view_block = self._per_view_blocks(pose_jacobians, views, twist_rows)
        per_view_gradient = jnp.einsum("vki,vk->vi", per_view, twist_gradient[: len(per_view)])

        def take(x: Array, axis: int) -> Array:
            """Return the entries of the free parameters, and then of the shape, in their units."""
            return self._take_free_and_shape(x, axis, count)

        return (
            Step(take(gradient, 0), per_view_gradient),
            BlockArrow(take(take(matrix, 0), 1), take(border, 2), per_view_block),
        )

    def _take_free_and_shape(self, x: Array, axis: int, direct_count: int) -> Array:
        """Return the entries of the free shared parameters, and then of the target's shape.

        Args:
            x: an array by the camera's parameters, the shape's coefficients, and all others.
            axis: its axis of the parameters.
            direct_count: number of the camera's parameters and the shape's coefficients.
        """
        camera_count = self.parameters.layout.camera.stop
        shape_count = direct_count - camera_count
        others = jnp.where(self.free < camera_count, 0, shape_count)
        indices = jnp.append(self.free + others, jnp.arange(camera_count, direct_count))
        scale = jnp.append(self.scale.shared, jnp.ones(shape_count))
        # Padding has an index after the last parameter.
        taken = jnp.take(x, indices, axis=axis, mode="fill", fill_value=0.0)
        return taken * jnp.expand_dims(scale, [k for k in range(x.ndim) if k != axis])

    def _per_view_blocks(
        self,
        pose_jacobians: PoseJacobians,
        views: ViewNormalEquations,
        twist_rows: Float[Array, "views 6 columns"],
    ) -> tuple[
        Float[Array, "corrected 6 6"],
        Float[Array, "corrected 6 columns"],
        Float[Array, "corrected 6 6"],
    ]:
        """Return the Jacobian O of each view's twist, `O^T [G_td, G_tt T]` and `O^T G_tt O`.

        Without a noise model no view has a correction, and all three are empty.
        """
        per_view = self._per_view_jacobian(pose_jacobians)
        corrected_views = slice(len(views.cost) if len(per_view) else 0)
        per_view_transposed = jnp.swapaxes(per_view, 1, 2)
        return (
            per_view,
            per_view_transposed @ twist_rows[corrected_views],
            per_view_transposed @ views.matrix[corrected_views, _TWIST, _TWIST] @ per_view,
        )

    def _shared_jacobian(self, pose_jacobians: PoseJacobians) -> Float[Array, "views columns free"]:
        """Return the derivative of camera and twist of each view by the shared parameters."""
        # S_v = [[1, 0], [0, T_v]]: the camera's parameters are themselves, all others act through
        # the twist of the view's pose, T_v = `PoseJacobians.shared_jacobian`.
        layout = self.parameters.layout
        n, size = layout.camera.stop, layout.size
        count = len(pose_jacobians.shared_jacobian)
        camera = jnp.broadcast_to(jnp.eye(n, size)[None], (count, n, size))
        twist = jnp.pad(pose_jacobians.shared_jacobian, ((0, 0), (0, 0), (n, 0)))
        shared = self._take_free(jnp.concatenate([camera, twist], axis=1))
        return shared * self.scale.shared[None, None]

    def _per_view_jacobian(self, pose_jacobians: PoseJacobians) -> Float[Array, "corrected 6 6"]:
        """Return the derivative of each view's twist by its own parameters.

        Columns of fixed parameters are zero.
        """
        free_scale = jnp.where(self.per_view_free, self.scale.per_view, 0.0)
        jacobian = pose_jacobians.per_view_jacobian
        if self.correction_roots is not None:
            jacobian = jacobian @ self.correction_roots
        return jacobian * free_scale[:, None, :]

    def gradients_by_view(self, z: Step) -> Float[Array, "views free"]:
        """Return every view's term of the shared parameters' gradient."""
        pose_jacobians = self._linearise_poses(z)
        views = self._view_normal_equations(pose_jacobians)
        shared = self._shared_jacobian(pose_jacobians)
        gradients = jnp.einsum("vki,vk->vi", shared, views.gradient)
        if not self.has_depths:
            return gradients
        return gradients + self._depth_equations(pose_jacobians).shared_gradients

    def blocks_by_view(self, z: Step) -> ViewBlocks:
        """Return every view's own term of the matrix of the normal equations, without priors."""
        pose_jacobians = self._linearise_poses(z)
        views = self._view_normal_equations(pose_jacobians)
        shared = self._shared_jacobian(pose_jacobians)
        matrix_shared = views.matrix @ shared
        _, border, block = self._per_view_blocks(pose_jacobians, views, matrix_shared[:, _TWIST])
        blocks = ViewBlocks(jnp.swapaxes(shared, 1, 2) @ matrix_shared, border, block)
        if not self.has_depths:
            return blocks
        return jax.tree.map(jnp.add, blocks, self._depth_equations(pose_jacobians).blocks)
