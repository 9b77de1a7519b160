"""Compute the information that views carry about a calibration, before any picture is taken.

The pixels of a view depend on its pose and on parameters common to all views; the error of its
reported pose is independent. With this error marginalised, every view has its own information
matrix for the shared parameters (Fisher information), and the matrices of independent views add up.
So candidates are linearised once, and the information of any set of them is a sum. The inverse of
the sum is the Cramer-Rao bound, as computed by `cramer_rao`.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..dataset import Dataset, Observations
from ..engine import JointProblem, Noise, Prior, Step, build_problem
from ..geometry import look_at, transform_points
from ..robot_errors import FieldChoice, nominal_arm
from ..robots import Command, JointsLike
from ..runtime.array_namespace import as_float_array, to_device
from ..runtime.compilation import compiled_optimised
from .checks import border_distance


class InformationModel(eqx.Module):
    """A model of a calibration, a target and error sizes, which gives the information of views.

    Attributes:
        problem: shared parameters, priors and error sizes; its observations are not used.
        points: target points, m.
        prior_information: information matrix that is available without any view.
        near: joint readings near which an arm takes its views; None for robots commanded by poses.
            A view that the arm cannot reach from there has no visible points.
        parameter_names: names of the free parameters, in the order of all matrices here.
    """

    problem: JointProblem
    points: Float[Array, "points 3"]
    prior_information: Float[Array, "free free"]
    near: Float[Array, "joints"] | None
    parameter_names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def from_calibration(
        cls,
        calibration: Calibration,
        points: Float[Array, "points 3"] | np.ndarray,
        noise: Noise | float,
        *,
        field: FieldChoice = "auto",
        fixed: Sequence[str] = (),
        free: Sequence[str] = (),
        priors: Mapping[str, Prior] | None = None,
        previous_data: Dataset | None = None,
        near: JointsLike | None = None,
    ) -> "InformationModel":
        """Return a model from the same arguments as a fit or a Cramer-Rao bound.

        Errors have the same meaning as there.

        Args:
            calibration: the true calibration as far as it is known; nominal values suffice for a
                start.
            points: target points, m.
            noise: sizes of all errors; a number is the pixel sigma, with an exact robot.
            field: robot error field, with one standard deviation for each of its groups in `noise`.
            fixed: paths of known parameters, as in a fit; `free` in the same way.
            free: see `fixed`.
            priors: priors as in a fit: the knowledge before any view is taken.
            previous_data: views that have already been taken.
            near: joint readings, `(joints)`, from which an arm starts towards a view; required if
                arm errors are fitted or are the field.

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
        robot_noise = noise if isinstance(noise, Noise) else "trusted"
        built = build_problem(
            data, calibration, noise=robot_noise, field=field, fixed=fixed, free=free, priors=priors
        )
        problem = built.problem
        if not isinstance(noise, Noise):
            sigma = to_device(float(noise))
            problem = eqx.tree_at(lambda p: p.pixel_sigma, problem, sigma)
        # Prior information is the square of the weight on each free parameter.
        weight = np.asarray(problem.prior_weight.shared)[np.asarray(problem.free)]
        near_joints = None if arm is None or near is None else as_float_array(near)
        prior = to_device(np.diag(weight**2))
        model = cls(problem, target, prior, near_joints, built.shared_names)
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

    @compiled_optimised
    def information(self, camera_from_world: SE3) -> Float[Array, "views free free"]:
        """Return the information matrix of every view `(views)`, at the robot's commanded pose."""
        # Per view, the Schur complement of its own pose correction in the normal equations:
        #     F = S^T S - S^T O (O^T O + P)^-1 O^T S
        # for residual Jacobians S by shared parameters and O by the correction, with prior
        # precision P.
        return self._with_observations(
            self.expected_observations(camera_from_world)
        ).information_by_view(self._zero_step(len(camera_from_world.wxyz_xyz)))

    @compiled_optimised
    def dataset_information(self, data: Dataset) -> Float[Array, "views free free"]:
        """Return the information matrix of every view of a data set."""
        problem = self._with_observations(data.observations)
        return problem.information_by_view(self._zero_step(len(data.visible)))

    @compiled_optimised
    def pixel_moment_matrix(self, camera_from_world: SE3) -> Float[Array, "free free"]:
        """Return the mean squared displacement of pixels by the parameters, as a matrix.

        For views `(views)`, `step @ pixel_moment_matrix @ step` is the mean over all visible points
        of the squared displacement, u and v together, px^2, to first order.
        """
        observations = self.expected_observations(camera_from_world)
        # With a pixel sigma of 1 px the information J^T J of the pixels is the sum of squared
        # displacements; it is divided by the number of visible points.
        problem = eqx.tree_at(
            lambda p: p.pixel_sigma, self._with_observations(observations), jnp.ones(())
        )
        _, information_by_view = problem.normal_equations_by_view(
            self._zero_step(len(observations.visible))
        )
        return jnp.sum(information_by_view, axis=0) / jnp.maximum(
            jnp.sum(observations.visible.astype(float)), 1.0
        )

    def expected_observations(self, camera_from_world: SE3) -> Observations:
        """Return the observations that views would have; their pixel values are unused."""
        command, reached = self._command(camera_from_world)
        views, count = len(camera_from_world.wxyz_xyz), len(self.points)
        return Observations(
            jnp.broadcast_to(self.points[None], (views, count, 3)),
            jnp.zeros((views, count, 2)),
            reached[:, None] & (self._border_distance(camera_from_world) >= 0.0),
            command.base_from_tool,
            command.joints,
        )

    def border_distance(self, camera_from_world: SE3) -> Float[Array, "views points"]:
        """Return the distance of every point from the picture's border, px.

        It is minus infinity where the arm does not reach the view.
        """
        distance = self._border_distance(camera_from_world)
        if self.near is None:
            return distance
        _, reached = self._command(camera_from_world)
        return jnp.where(reached[:, None], distance, -jnp.inf)

    def _border_distance(self, camera_from_world: SE3) -> Float[Array, "views points"]:
        """Return the distance of every point from the picture's border, px, for any robot."""
        points = self.calibration.target_scale * self.points
        return border_distance(self.calibration, transform_points(camera_from_world, points))

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

    def _with_observations(self, observations: Observations) -> JointProblem:
        """Return the problem with other views, which have corrections if the problem has any."""
        views = len(observations.visible)

        # The priors of corrections are the same for all views; the first is repeated.
        def repeat_first(per_view: Array) -> Array:
            return jnp.broadcast_to(per_view[:1], (views, 6)) if len(per_view) else per_view

        problem = self.problem.with_observations(observations)
        mean, weight, scale = (
            Step(step.shared, repeat_first(step.per_view))
            for step in (problem.prior_mean, problem.prior_weight, problem.scale)
        )
        return dataclasses.replace(
            problem,
            per_view_free=repeat_first(problem.per_view_free),
            prior_mean=mean,
            prior_weight=weight,
            scale=scale,
        )

    def _zero_step(self, views: int) -> Step:
        """Return a step of zero, for the given number of views."""
        corrected_views = views if len(self.problem.per_view_free) else 0
        return Step(jnp.zeros(len(self.parameter_names)), jnp.zeros((corrected_views, 6)))


def _placeholder_commands(calibration: Calibration, points: Float[Array, "points 3"]) -> SE3:
    """Return three arbitrary views, which do not affect the used parts of the problem."""
    target = np.asarray(points)
    size, middle = np.ptp(target, axis=0).max(), target.mean(axis=0)
    facing = look_at(middle, np.array([[0.0, 0.0, -1.0]] * 3), 10.0 * size)
    return calibration.command_for(facing)
