"""The joint fit of several cameras that watched one robot, as a least-squares problem.

Each camera's observations are linearised as if it were alone (`problem.py`). The results are then
added up by the rig's parameters: cameras of one target share its pose, all share the robot's
errors, and views that were taken in one state of the robot share the correction of that state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ..robot_errors import RobotError
from ..robots import Command
from ..runtime.array_namespace import AnyArray
from ..runtime.modules import HostModule
from .abstract_problem import AbstractRigProblem, NormalEquations, ViewBlocks
from .parameters import Step
from .pixel_aspect import FittedAspects, joined_aspects
from .prepared_poses import PreparedPoses, prepare_poses
from .problem import FittedChain, JointProblem
from .schur import BlockArrow

_Tree = TypeVar("_Tree")


class CameraGroup(HostModule):
    """Cameras with the same kind of lens and mount, stacked, so that one program serves them all.

    Attributes:
        problems: the problem of each camera alone, stacked along a first axis; all shared
            parameters and all corrections are free, without priors.
        parameter_index: index among the rig's parameters of each of a camera's.
        state_index: index of the robot's state in each view; for padding the number of states, at
            which the solver may add one that no camera saw.
    """

    problems: JointProblem
    parameter_index: Int[Array, "*cameras local"]
    state_index: Int[Array, "*cameras views"]


class RigProblem(AbstractRigProblem):
    """A least-squares problem: all cameras' observations, one robot, and priors.

    The views' own parameters are here the corrections of the robot's states.

    Attributes:
        groups: the cameras, stacked by lens and mount.
        command: what the robot reported in each state.
        start_error: the robot's error at the start; None without a field.
        pixel_sigma: factor of all cameras' pixel sigmas.
        camera_mask: as in `AbstractRigProblem`.
        free, per_view_free, prior_mean, prior_weight, scale, mesh: as in `AbstractProblem`.
        correction_roots: the twist of each state's correction by its own six parameters, where the
            errors of poses differ by direction; None if the parameters are the twist.
    """

    groups: tuple[CameraGroup, ...]
    command: Command
    start_error: RobotError | None
    pixel_sigma: Float[Array, ""]
    camera_mask: Bool[Array, "shared"]
    free: Int[Array, "free"]
    per_view_free: Bool[Array, "states 6"]
    prior_mean: Step
    prior_weight: Step
    scale: Step
    mesh: Mesh | None = eqx.field(static=True, default=None)
    correction_roots: Float[AnyArray, "states 6 6"] | None = None

    @property
    def host_correction_roots(self) -> Float[np.ndarray, "states 6 6"] | None:
        """The roots of the corrections as a NumPy array, as in `AbstractProblem`."""
        return None if self.correction_roots is None else np.asarray(self.correction_roots)

    @property
    def robot_error(self) -> RobotError | None:
        """The robot's error at the start; None without a field."""
        return self.start_error

    @property
    def parts(self) -> list[Any]:
        """The problems of the cameras, stacked by kind."""
        return [group.problems for group in self.groups]

    @property
    def fitted_aspects(self) -> FittedAspects | None:
        """The cameras whose ratio of focal lengths is fitted in the place of alpha_v."""
        groups = [(g.parameter_index, g.problems.parameters.fits_aspect) for g in self.groups]
        fitted = [(np.asarray(index)[:, :2], fits) for index, fits in groups if fits is not None]
        return joined_aspects([FittedAspects(*of_group) for of_group in fitted])

    def start_values(self) -> Float[Array, "shared"]:
        """Return the values of the shared parameters at the start."""
        values = jnp.zeros(self.parameter_count)
        for group in self.groups:
            starts = jax.vmap(lambda problem: problem.start_values())(group.problems)
            values = values.at[group.parameter_index].set(starts)
        return values

    def host_start_values(self) -> Float[np.ndarray, "shared"]:
        """Return `start_values`, computed with NumPy."""
        values = np.zeros(self.parameter_count)
        for group in self.groups:
            of_cameras = jax.tree.map(np.asarray, group.problems.parameters)
            for camera, index in enumerate(np.asarray(group.parameter_index)):
                parameters = jax.tree.map(lambda x, k=camera: x[k], of_cameras)
                values[index] = parameters.values(np)
        return values

    def with_noise_corrections(self, corrections: Float[np.ndarray, "states 6"]) -> "RigProblem":
        """Return the problem with the robot error field at poses corrected for noise."""
        prepared = prepare_poses(self.start_error, self.command, corrections)
        groups = tuple(_with_prepared_poses(group, prepared) for group in self.groups)
        return dataclasses.replace(self, groups=groups)

    def with_correction_roots(self, roots: Float[np.ndarray, "states 6 6"]) -> "RigProblem":
        """Return the problem with other axes of the states' own parameters."""
        groups = tuple(
            eqx.tree_at(
                lambda g: g.problems.correction_roots,
                group,
                _of_views(group, roots),
                is_leaf=lambda x: x is None,
            )
            for group in self.groups
        )
        return dataclasses.replace(self, groups=groups, correction_roots=roots)

    def observation_residuals(self, z: Step) -> tuple[Any, ...]:
        """Return the whitened residuals of each group's pixels, and of its depths if it has any."""
        return self._by_group(z, lambda problem, step: problem.observation_residuals(step))

    def chain(self, z: Step) -> tuple[FittedChain, ...]:
        """Return the chains of each group's cameras, stacked, at a scaled step."""
        return self._by_group(z, lambda problem, step: problem.chain(step))

    def normal_equations_without_priors(self, z: Step) -> NormalEquations:
        """Return the normal equations of the observations alone, without priors."""
        size, states = self.parameter_count, len(self.per_view_free)
        cost = jnp.zeros(())
        gradient = Step(jnp.zeros(size), jnp.zeros((states, 6)))
        shared, per_view = jnp.zeros((size, size)), jnp.zeros((states, 6, 6))
        border = jnp.zeros((states, 6, size))
        for group, equations in zip(self.groups, self._camera_equations(z), strict=True):
            place, state = group.parameter_index, group.state_index
            cost = cost + jnp.sum(equations.cost)
            # Padding of the views has a state after the last one.
            gradient = Step(
                gradient.shared.at[place].add(equations.gradient.shared),
                gradient.per_view.at[state].add(equations.gradient.per_view, mode="drop"),
            )
            shared = shared.at[place[:, :, None], place[:, None]].add(equations.matrix.shared)
            per_view = per_view.at[state].add(equations.matrix.per_view, mode="drop")
            rows = jnp.arange(6)[None, None, :, None]
            border = border.at[state[:, :, None, None], rows, place[:, None, None]].add(
                equations.matrix.border, mode="drop"
            )
        matrix = BlockArrow(shared, border, per_view)
        return self.of_free_parameters(NormalEquations(cost, gradient, matrix))

    def blocks_by_view(self, z: Step) -> ViewBlocks:
        """Return what each state adds to the matrix, of all cameras that saw their targets."""
        size, states = self.parameter_count, len(self.per_view_free)
        shared, per_view = jnp.zeros((states, size, size)), jnp.zeros((states, 6, 6))
        border = jnp.zeros((states, 6, size))
        by_group = self._by_group(z, lambda problem, step: problem.blocks_by_view(step))
        for group, blocks in zip(self.groups, by_group, strict=True):
            place, state = group.parameter_index[:, None], group.state_index
            # Padding of the views has a state after the last one.
            by_row = state[..., None, None]
            shared = shared.at[by_row, place[..., None], place[:, :, None]].add(
                blocks.shared, mode="drop"
            )
            per_view = per_view.at[state].add(blocks.per_view, mode="drop")
            rows = jnp.arange(6)[None, None, :, None]
            border = border.at[by_row, rows, place[:, :, None]].add(blocks.border, mode="drop")
        return ViewBlocks(*self.by_free_parameters(shared, border, per_view))

    def view_distances(self, z: Step) -> tuple[Float[Array, "cameras views"], ...]:
        """Return by how much twice the cost would fall if a single view had a pose of its own.

        To first order, for each group's cameras and views: chi-square with six degrees of freedom
        if a view agrees with the others. It is NaN for a view whose points do not tell its pose.
        """
        distances = []
        for equations in self._camera_equations(z):
            gradient, matrix = equations.gradient.per_view, equations.matrix.per_view
            whitened = jnp.linalg.solve(matrix, gradient[..., None])[..., 0]
            distances.append(jnp.sum(gradient * whitened, axis=-1))
        return tuple(distances)

    def _camera_equations(self, z: Step) -> tuple[NormalEquations, ...]:
        """Return the normal equations of each group's cameras alone, stacked."""
        return self._by_group(
            z, lambda problem, step: problem.normal_equations_without_priors(step)
        )

    def _by_group(self, z: Step, evaluate: Callable[[JointProblem, Step], Any]) -> tuple[Any, ...]:
        """Evaluate every camera's problem at its own part of a step; stacked for each group."""
        step = self.unscaled_step(z)

        def of_camera(camera: CameraGroup) -> Any:
            """Evaluate one camera; a correction of padding is zero."""
            corrections = step.per_view.at[camera.state_index].get(mode="fill", fill_value=0.0)
            of_one_camera = Step(step.shared[camera.parameter_index], corrections)
            return evaluate(camera.problems, of_one_camera)

        return tuple(jax.lax.map(of_camera, self._with_sigmas(group)) for group in self.groups)

    def _with_sigmas(self, group: CameraGroup) -> CameraGroup:
        """Return a group with the pixel sigmas of this problem."""
        sigmas = self.pixel_sigma * group.problems.pixel_sigma
        return eqx.tree_at(lambda g: g.problems.pixel_sigma, group, sigmas)


def _with_prepared_poses(group: CameraGroup, prepared: PreparedPoses | None) -> CameraGroup:
    """Return a group whose robot error field is evaluated at the prepared poses of the states."""
    if prepared is None:
        return group
    return eqx.tree_at(lambda g: g.problems.prepared_poses, group, _of_views(group, prepared))


def _of_views(group: CameraGroup, of_states: _Tree) -> _Tree:
    """Return arrays by state for the views of each camera; padding has the last state's."""
    states = np.asarray(group.state_index)
    return jax.tree.map(
        lambda x: np.asarray(x)[np.minimum(states, len(np.asarray(x)) - 1)], of_states
    )
