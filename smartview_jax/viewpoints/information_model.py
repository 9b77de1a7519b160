"""Compute the information that views carry about a calibration, before any picture is taken.

The pixels of a view depend on its pose and on parameters common to all views; the error of its
reported pose is independent. With this error marginalised, every view has its own information
matrix for the shared parameters (Fisher information), and the matrices of independent views add up.
So candidates are linearised once, and the information of any set of them is a sum. The inverse of
the sum is the Cramer-Rao bound, as computed by `cramer_rao`.
"""

import dataclasses
import operator
from typing import Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..dataset import Dataset, DepthNoise, DepthReadings, Observations, depth_precision
from ..engine import (
    JointProblem,
    Noise,
    ParameterOptions,
    Parameters,
    Step,
    build_problem,
    padded,
    with_weighed_depths,
)
from ..geometry import look_at, transform_points
from ..robot_errors import FieldChoice, nominal_arm
from ..robots import Command, JointsLike
from ..runtime.array_namespace import as_float_array, to_device
from ..runtime.compilation import compiled_optimised, is_traced, one_program
from ..runtime.modules import with_fields
from ..runtime.padding import MIN_PADDED_VIEWS, in_batches, padded_counts, repeat_last
from .checks import border_distance


class InformationModel(eqx.Module):
    """A model of a calibration, a target and error sizes, which gives the information of views.

    Attributes:
        problem: shared parameters, priors and error sizes; its observations are not used.
        points: target points, m.
        prior_information: information matrix that is available without any view.
        near: joint readings near which an arm takes its views; None for robots commanded by poses.
            A view that the arm cannot reach from there has no visible points.
        depth_noise: constant, quadratic and common part of the noise of the depths that a view
            has, as in `DepthNoise`; None for a camera without a depth sensor.
        parameter_names: names of the free parameters, in the order of all matrices here.
    """

    problem: JointProblem
    points: Float[Array, "points 3"]
    prior_information: Float[Array, "free free"]
    near: Float[Array, "joints"] | None
    depth_noise: Float[Array, "3"] | None
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def from_calibration(
        cls,
        calibration: Calibration,
        points: Float[Array, "points 3"] | np.ndarray,
        noise: Noise | float,
        *,
        field: FieldChoice = "auto",
        previous_data: Dataset | None = None,
        near: JointsLike | None = None,
        depth_noise: DepthNoise | None = None,
        **parameters: Unpack[ParameterOptions],
    ) -> "InformationModel":
        """Return a model from the same arguments as a fit or a Cramer-Rao bound.

        Errors have the same meaning as there.

        Args:
            calibration: the true calibration as far as it is known; nominal values suffice for a
                start.
            points: target points, m.
            noise: sizes of all errors; a number is the pixel sigma, with an exact robot.
            field: robot error field, with one standard deviation for each of its groups in `noise`.
            previous_data: views that have already been taken.
            near: joint readings, `(joints)`, from which an arm starts towards a view; required if
                arm errors are fitted or are the field.
            depth_noise: noise of the depths of a camera that measures them in each view; by default
                the noise in the previous data, which have depths or have none.
            parameters: `fixed`, paths of known parameters, and `free` as in a fit; `priors`, the
                knowledge before any view is taken.

        Raises:
            ValueError: arm errors without `near`, or as in `fit_joint`.
        """
        target = as_float_array(points)
        arm = nominal_arm(calibration.field if field == "auto" else field)
        if arm is not None and near is None:
            raise ValueError(
                "an arm reaches a view in several ways: give near=joints to begin from"
            )
        # Building the problem needs a data set. Three arbitrary views suffice, since only the
        # priors and the parameter layout are used.
        data = Dataset.from_arrays(
            target,
            np.zeros((3, len(target), 2)),
            _placeholder_commands(calibration, target) if arm is None else None,
            calibration.camera.image_size,
            mount=calibration.mount,
            joints=None if arm is None else np.tile(np.asarray(near, dtype=float), (3, 1)),
            arm=arm,
        )
        if depth_noise is None and previous_data is not None:
            depth_noise = previous_data.depth_noise
        depth_sizes = None
        if depth_noise is not None:
            data = data.with_depths(np.ones((3, len(target))), depth_noise)
            sizes = depth_noise.constant, depth_noise.quadratic, depth_noise.common or 0.0
            depth_sizes = to_device(np.array(sizes))
        robot_noise = noise if isinstance(noise, Noise) else "trusted"
        built = build_problem(data, calibration, noise=robot_noise, field=field, **parameters)
        problem = built.problem
        if not isinstance(noise, Noise):
            sigma = to_device(float(noise))
            problem = eqx.tree_at(lambda p: p.pixel_sigma, problem, sigma)
        near_joints = None if arm is None or near is None else as_float_array(near)
        prior = to_device(problem.host_prior_information())
        # All matrices are by the parameters as they are named.
        problem = with_fields(problem, parameters=Parameters(problem.parameters.start))
        model = cls(problem, target, prior, near_joints, depth_sizes, built.shared_names)
        if previous_data is None:
            return model
        previous_information = jnp.sum(model.dataset_information(previous_data), axis=0)
        return eqx.tree_at(
            lambda s: s.prior_information, model, model.prior_information + previous_information
        )

    @property
    def calibration(self) -> Calibration:
        """The calibration at which views are linearised."""
        return self.problem.parameters.start

    def information(self, camera_from_world: SE3) -> Float[Array, "views free free"]:
        """Return the information matrix of every view `(views)`, at the robot's commanded pose."""
        return self._matrices(self.expected_observations(camera_from_world))[1]

    def dataset_information(self, data: Dataset) -> Float[Array, "views free free"]:
        """Return the information matrix of every view of a data set."""
        if self.depth_noise is None:
            data = data.with_depths(None)
        weighed = with_weighed_depths(data, float(self.problem.pixel_sigma))
        return self._matrices(weighed.observations)[1]

    def pixel_moment_matrix(self, camera_from_world: SE3) -> Float[Array, "free free"]:
        """Return the mean squared displacement of pixels by the parameters, as a matrix.

        For views `(views)`, `step @ pixel_moment_matrix @ step` is the mean over all visible points
        of the squared displacement, u and v together, px^2, to first order.
        """
        observations = with_fields(self.expected_observations(camera_from_world), depths=None)
        # With a pixel sigma of 1 px the information J^T J of the pixels is the sum of squared
        # displacements; it is divided by the number of visible points.
        model = eqx.tree_at(lambda m: m.problem.pixel_sigma, self, to_device(np.ones(())))
        return _mean_by_point(model._matrices(observations)[0], observations.visible)

    def expected_observations(self, camera_from_world: SE3) -> Observations:
        """Return the observations that views would have; their pixel values are unused."""
        return self._expected(camera_from_world)[0]

    def border_distance(self, camera_from_world: SE3) -> Float[Array, "views points"]:
        """Return the distance of every point from the picture's border, px.

        It is minus infinity where the arm does not reach the view.
        """
        return self._expected(camera_from_world)[1]

    def _expected(
        self, camera_from_world: SE3
    ) -> tuple[Observations, Float[Array, "views points"]]:
        """Return what views would show, and the distance of every point from the border, px."""
        if is_traced(self, camera_from_world):
            return _expected(self, camera_from_world)
        model, count = self._for_programs(), len(self.points)
        observations, distance = in_batches(
            lambda batch: _expected(model, batch), camera_from_world, MIN_PADDED_VIEWS
        )
        arrays = ["points", "pixels", "visible"]
        if observations.depths is not None:
            arrays += ["depths.measured", "depths.precision"]
        by_point = operator.attrgetter(*arrays)
        seen = eqx.tree_at(by_point, observations, [x[:, :count] for x in by_point(observations)])
        return jax.device_put((seen, distance[:, :count]))

    def _expected_depths(self, depth: Float[Array, "views points"]) -> DepthReadings | None:
        """Return the readings of a sensor without bias; None for a camera without one."""
        if self.depth_noise is None:
            return None
        constant, quadratic, common = self.depth_noise
        precision = depth_precision(depth, constant, quadratic)
        every_view = jnp.ones(len(depth))
        pixel_sigma = self.problem.pixel_sigma * every_view
        return DepthReadings(depth, precision, common * every_view, pixel_sigma)

    def _matrices(
        self, observations: Observations
    ) -> tuple[Float[Array, "views free free"], Float[Array, "views free free"]]:
        """Return the matrix of the shared parameters of every view, and its information matrix."""
        if is_traced(self, observations):
            return _matrices(self.problem, observations)
        problem, free = self._for_programs().problem, len(self.parameter_names)
        views, points = observations.visible.shape
        seen = observations.padded_to(views, _padded_points(points))
        matrices = in_batches(lambda batch: _matrices(problem, batch), seen, MIN_PADDED_VIEWS)
        return jax.device_put(tuple(matrix[:, :free, :free] for matrix in matrices))

    def _for_programs(self) -> "InformationModel":
        """Return the model with padding, and without what the programs do not use.

        Models of other targets and free parameters then use the same programs.
        """
        return dataclasses.replace(
            self,
            problem=padded(self.problem),
            points=to_device(repeat_last(self.points, _padded_points(len(self.points)))),
            prior_information=to_device(np.zeros((0, 0))),
            parameter_names=(),
        )

    def _command(self, camera_from_world: SE3) -> tuple[Command, Bool[Array, "views"]]:
        """Return the robot command, and whether the robot reaches it.

        If not, the command is a placeholder that keeps all results finite.
        """
        views = len(camera_from_world.wxyz_xyz)
        if self.near is None:
            command = self.calibration.robot_command_for(camera_from_world)
            return command, jnp.ones(views, dtype=bool)
        near = jnp.broadcast_to(self.near[None], (views, len(self.near)))
        joints = self.calibration.joints_for(camera_from_world, near)
        reached = jnp.all(jnp.isfinite(joints), axis=-1)
        error = self.calibration.robot_error
        arm = None if error is None else nominal_arm(error.field)
        assert arm is not None
        return arm.command(jnp.where(reached[:, None], joints, near)), reached


def _padded_points(points: int) -> int:
    """Return the number of points to which a target is padded."""
    return padded_counts(1, points)[1]


@compiled_optimised
def _expected(
    model: InformationModel, camera_from_world: SE3
) -> tuple[Observations, Float[Array, "views points"]]:
    """Return what views would show, and the distance of every point from the border, px."""
    command, reached = model._command(camera_from_world)
    in_camera = transform_points(camera_from_world, model.calibration.target_scale * model.points)
    distance = border_distance(model.calibration, in_camera)
    distance = jnp.where(reached[:, None], distance, -jnp.inf)
    views, count = distance.shape
    observations = Observations(
        jnp.broadcast_to(model.points[None], (views, count, 3)),
        jnp.zeros((views, count, 2)),
        distance >= 0.0,
        command.base_from_tool,
        command.joints,
        model._expected_depths(in_camera[..., 2]),
    )
    return observations, distance


@compiled_optimised
def _matrices(
    problem: JointProblem, observations: Observations
) -> tuple[Float[Array, "views free free"], Float[Array, "views free free"]]:
    """Return the matrix of the shared parameters of every view, and its information matrix."""
    # Per view, the Schur complement of its own pose correction in the normal equations:
    #     F = S^T S - S^T O (O^T O + P)^-1 O^T S
    # for residual Jacobians S by shared parameters and O by the correction, with prior
    # precision P.
    problem = _with_observations(problem, observations)
    corrected_views = len(problem.per_view_free)
    zero = Step(jnp.zeros(len(problem.free)), jnp.zeros((corrected_views, 6)))
    blocks = problem.blocks_by_view(zero)
    return blocks.shared, problem.without_corrections(blocks)


def _with_observations(problem: JointProblem, observations: Observations) -> JointProblem:
    """Return a problem with other views, which have corrections if the problem has any."""
    views = len(observations.visible)

    # The priors of corrections are the same for all views; the first is repeated.
    def repeat_first(per_view: Array) -> Array:
        return jnp.broadcast_to(per_view[:1], (views, 6)) if len(per_view) else per_view

    mean, weight, scale = (
        Step(step.shared, repeat_first(step.per_view))
        for step in (problem.prior_mean, problem.prior_weight, problem.scale)
    )
    return dataclasses.replace(
        problem.with_observations(observations),
        correction_roots=None,
        per_view_free=repeat_first(problem.per_view_free),
        prior_mean=mean,
        prior_weight=weight,
        scale=scale,
    )


@one_program
def _mean_by_point(
    by_view: Float[Array, "views free free"], visible: Bool[Array, "views points"]
) -> Float[Array, "free free"]:
    """Return the sum over views, divided by the number of visible points."""
    return jnp.sum(by_view, axis=0) / jnp.maximum(jnp.sum(visible.astype(float)), 1.0)


def _placeholder_commands(calibration: Calibration, points: Float[Array, "points 3"]) -> SE3:
    """Return three arbitrary views, which do not affect the used parts of the problem."""
    target = np.asarray(points)
    size, middle = np.ptp(target, axis=0).max(), target.mean(axis=0)
    facing = look_at(middle, np.array([[0.0, 0.0, -1.0]] * 3), 10.0 * size)
    return calibration.command_for(facing)
