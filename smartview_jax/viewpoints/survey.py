"""What views will tell of a calibration, before a picture is taken.

Pixels depend on a view's pose and on what all views share; errors of the reported pose belong to
that view alone. With those integrated out, every view tells of the shared parameters by a matrix of
its own (Fisher information), and the matrices of independent views add up. So candidates are
linearised once, and what any set of them would tell is a sum. The inverse of that sum is the
Cramer-Rao bound, as `cramer_rao` has it.
"""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..compilation import optimised
from ..dataset import Dataset, Observations
from ..engine import JointProblem, Noise, Prior, Step, build_problem
from ..geometry import look_at, transform_points
from ..robot_errors import AbstractField, arm_of
from ..robots import Command, JointsLike
from .checks import border_distance


class Survey(eqx.Module):
    """A calibration, a target and the sizes of all errors: what any view of it would tell.

    Attributes:
        problem: its shared parameters, priors and sizes; its observations are not used.
        points: of the target, m.
        prior: information that is there without any view.
        near: joint readings in whose neighbourhood an arm takes its views; None for robots that are
            told poses. A view that the arm does not reach from there shows nothing.
        names: of the free parameters, in the order of all matrices here.
    """

    problem: JointProblem
    points: Float[Array, "points 3"]
    prior: Float[Array, "free free"]
    near: Float[Array, "joints"] | None
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        points: Float[Array, "points 3"] | np.ndarray,
        noise: Noise | float,
        field: AbstractField | None = None,
        fixed: Sequence[str] = (),
        free: Sequence[str] = (),
        priors: Mapping[str, Prior] | None = None,
        past: Dataset | None = None,
        near: JointsLike | None = None,
    ) -> "Survey":
        """Made from the same words as a fit, or a bound; errors as there.

        Args:
            calibration: the truth, as far as it is known: nominal numbers will do for a start.
            points: of the target, m.
            noise: sizes of all errors; a number is that of pixels, with a robot that is exact.
            field: of the robot's error, with one deviation for each of its groups in the noise.
            fixed: paths that are known; and so are `free` and `priors`.
            free: see there.
            priors: see there; all that is known where no view has been taken.
            past: views that have been taken.
            near: joint readings, `(joints)`, from which an arm sets out for a view; where its own
                errors were fitted or are the field.

        Raises:
            ValueError: an arm's own errors, and no `near`, or as `fit_joint` does.
        """
        target = jnp.asarray(points, dtype=float)
        arm = arm_of(field or calibration.field)
        if arm is not None and near is None:
            raise ValueError(
                "an arm reaches a view in several ways: give near=joints to begin from"
            )
        data = Dataset.from_arrays(
            target,
            np.zeros((3, len(target), 2)),
            _stand_ins(calibration, target) if arm is None else None,
            calibration.camera.image_size,
            mount=calibration.mount,
            joints=None if arm is None else np.tile(np.asarray(near, dtype=float), (3, 1)),
            arm=arm,
        )
        robot = noise if isinstance(noise, Noise) else "trusted"
        built = build_problem(
            data, calibration, noise=robot, field=field, fixed=fixed, free=free, priors=priors
        )
        problem = built.problem
        if not isinstance(noise, Noise):
            sigma = jnp.asarray(float(noise))
            problem = eqx.tree_at(lambda p: p.pixel_sigma, problem, sigma)
        weight = problem.prior_weight.shared[np.array(problem.free, dtype=int)]
        at = None if arm is None else jnp.asarray(near, dtype=float)
        survey = cls(problem, target, jnp.diag(weight**2), at, built.names)
        if past is None:
            return survey
        told = jnp.sum(survey.information_of(past), axis=0)
        return eqx.tree_at(lambda s: s.prior, survey, survey.prior + told)

    @property
    def calibration(self) -> Calibration:
        return self.problem.parameters.start

    @optimised
    def information(self, camera_from_world: SE3) -> Float[Array, "views free free"]:
        """Of every view `(views)`, taken from where the robot is told to go for it."""
        return self._with(self.observed(camera_from_world)).information_by_view(
            self._start(len(camera_from_world.wxyz_xyz))
        )

    @optimised
    def information_of(self, data: Dataset) -> Float[Array, "views free free"]:
        """Of every view of a data set."""
        problem = self._with(data.observations)
        return problem.information_by_view(self._start(len(data.visible)))

    @optimised
    def moved_pixels(self, camera_from_world: SE3) -> Float[Array, "free free"]:
        """Mean squared pixels, u and v together, that parameters move in views `(views)`.

        `step @ moved_pixels @ step` is the mean over all points in the pictures, to first order.
        """
        seen = self.observed(camera_from_world)
        problem = eqx.tree_at(lambda p: p.pixel_sigma, self._with(seen), jnp.ones(()))
        _, told = problem.observed_by_view(self._start(len(seen.visible)))
        return jnp.sum(told, axis=0) / jnp.maximum(jnp.sum(seen.visible.astype(float)), 1.0)

    def observed(self, camera_from_world: SE3) -> Observations:
        """What would be seen: the points in the picture; their pixels do not matter."""
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
        """Of every point from the picture's border, px; minus infinity where no arm reaches."""
        distance = self._border_distance(camera_from_world)
        if self.near is None:
            return distance
        _, reached = self._command(camera_from_world)
        return jnp.where(reached[:, None], distance, -jnp.inf)

    def _border_distance(self, camera_from_world: SE3) -> Float[Array, "views points"]:
        points = self.calibration.target_scale * self.points
        return border_distance(self.calibration, transform_points(camera_from_world, points))

    def _command(self, camera_from_world: SE3) -> tuple[Command, Bool[Array, "views"]]:
        """What the robot is told, and whether it gets there; if not, what keeps numbers finite."""
        views = len(camera_from_world.wxyz_xyz)
        if self.near is None:
            command = self.calibration.reported_for(camera_from_world)
            return command, jnp.ones(views, dtype=bool)
        near = jnp.broadcast_to(self.near[None], (views, len(self.near)))
        joints = self.calibration.joints_for(camera_from_world, near)
        reached = jnp.all(jnp.isfinite(joints), axis=-1)
        error = self.calibration.robot_error
        arm = None if error is None else arm_of(error.field)
        assert arm is not None
        return arm.command(jnp.where(reached[:, None], joints, near)), reached

    def _with(self, observations: Observations) -> JointProblem:
        """The problem with other views; each with a correction of its own, where any has one."""
        views = len(observations.visible)

        def alike(of_views: Array) -> Array:
            return jnp.broadcast_to(of_views[:1], (views, 6)) if len(of_views) else of_views

        problem = self.problem
        return eqx.tree_at(
            lambda p: (
                p.observations,
                p.own_free,
                p.prior_mean.corrections,
                p.prior_weight.corrections,
                p.scale.corrections,
            ),
            problem,
            (
                observations,
                alike(problem.own_free),
                alike(problem.prior_mean.corrections),
                alike(problem.prior_weight.corrections),
                alike(problem.scale.corrections),
            ),
        )

    def _start(self, views: int) -> Step:
        corrected = views if len(self.problem.own_free) else 0
        return Step(jnp.zeros(len(self.names)), jnp.zeros((corrected, 6)))


def _stand_ins(calibration: Calibration, target: Float[Array, "points 3"]) -> SE3:
    """Three views that stand for any: what is taken of the problem does not depend on them."""
    size, middle = jnp.max(jnp.ptp(target, axis=0)), jnp.mean(target, axis=0)
    facing = look_at(middle, jnp.array([[0.0, 0.0, -1.0]] * 3), 10.0 * size)
    return calibration.command_for(facing)
