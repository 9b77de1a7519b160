"""The joint fit of several arms that see targets in common, as a least-squares problem.

Each arm is a rig of its own (`rig_problem.py`), and so is each pair of arms, a camera's
and its target's. The pose of a target on the table that several arms see is a
parameter in the base of the first arm, and so is the base of every other arm. The pose of the
target in another arm's base follows from both, and so does the base of a pair's other arm,

    base_from_world = first_base_from_base^-1 first_base_from_world
    base_from_other_base = first_base_from_base^-1 first_base_from_other_base

and the arms' equations are added up by this chain rule.
"""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..geometry import host_adjoints, host_logarithms, host_matrices
from ..robot_errors import RobotError
from ..runtime.modules import with_fields
from .abstract_problem import AbstractRigProblem, NormalEquations
from .parameters import (
    Step,
    host_retract_transform,
    retract_transform,
    rotation_vector_between,
    twist_by_step,
)
from .pixel_aspect import FittedAspects, joined_aspects
from .problem import FittedChain
from .rig_problem import RigProblem
from .schur import BlockArrow


class ArmInRig(eqx.Module):
    """An arm of several, or a pair: its problem alone, and where its parameters are among all.

    Its linked poses are the poses in its base of targets that other arms see, or of a pair the base
    of the target's arm. They follow from poses in the base of the first arm.

    Attributes:
        problem: the problem of the arm alone; all shared parameters are free.
        parameter_index: index among the parameters of all arms of each of the arm's; for a linked
            pose, of the pose in the base of the first arm. The base of the first arm itself has
            indices after the last parameter.
        base_index: index of the six parameters of the arm's base, in the base of the first arm.
        linked_poses: the arm's own indices of each linked pose; none for the first arm.
        first_base_from_base: base of the arm in the base of the first, at the start.
        first_base_from_linked: target or base of each linked pose in the base of the first arm, at
            the start.
        base_from_linked: each linked pose, at its own start.
    """

    problem: RigProblem
    parameter_index: Int[Array, "own"]
    base_index: Int[Array, "6"]
    linked_poses: Int[Array, "linked 6"]
    first_base_from_base: SE3
    first_base_from_linked: SE3
    base_from_linked: SE3

    def own_step(self, shared: Float[Array, "shared"]) -> Float[Array, "own"]:
        """Return the step of the arm's own parameters at a step of all arms' parameters."""
        with_first_base = jnp.append(shared, jnp.zeros(6))
        of_arm = with_first_base[self.parameter_index]
        if not len(self.linked_poses):
            return of_arm
        base = retract_transform(self.first_base_from_base, with_first_base[self.base_index])

        def of_linked(step: Float[Array, "6"], first: SE3, start: SE3) -> Float[Array, "6"]:
            """Return the step of a linked pose in the base of the arm."""
            pose = base.inverse() @ retract_transform(first, step)
            turn = rotation_vector_between(start, pose)
            return jnp.append(pose.translation() - start.translation(), turn)

        steps = jax.vmap(of_linked)(
            of_arm[self.linked_poses], self.first_base_from_linked, self.base_from_linked
        )
        return of_arm.at[self.linked_poses].set(steps)

    def host_jacobian(self, shared: Float[np.ndarray, "shared"]) -> Float[np.ndarray, "own shared"]:
        """Return the derivative of `own_step`, computed with NumPy."""
        index, base_index = np.asarray(self.parameter_index), np.asarray(self.base_index)
        count, shared = len(shared), np.append(shared, np.zeros(6))
        jacobian = np.zeros((len(index), len(shared)))
        jacobian[np.arange(len(index)), index] = 1.0
        for k, rows in enumerate(np.asarray(self.linked_poses)):
            columns, of_base, of_linked = index[rows], shared[base_index], shared[index[rows]]
            first, start = (
                SE3(pose.wxyz_xyz[k])
                for pose in (self.first_base_from_linked, self.base_from_linked)
            )
            base = host_matrices(host_retract_transform(self.first_base_from_base, of_base))
            linked = host_matrices(host_retract_transform(first, of_linked))
            # A small motion of a pose W in the first base moves the pose B^-1 W in the arm's base
            # by Ad(B^-1), and one of the arm's base by as much the other way.
            inverse = np.linalg.inv(base)
            pose = inverse @ linked
            turned = host_logarithms(pose @ np.linalg.inv(host_matrices(start)))[3:]
            by_motion = np.linalg.solve(twist_by_step(pose, turned), host_adjoints(inverse))
            jacobian[rows] = 0.0
            jacobian[np.ix_(rows, columns)] = by_motion @ twist_by_step(linked, of_linked[3:])
            jacobian[np.ix_(rows, base_index)] = -by_motion @ twist_by_step(base, of_base[3:])
        return jacobian[:, :count]


class ArmsProblem(AbstractRigProblem):
    """A least-squares problem: all arms' observations, and priors.

    The views' own parameters are the corrections of all arms' states, one arm after the other.

    Attributes:
        arms: the arms and pairs of arms; the base of the first arm is the reference.
        pixel_sigma: one; every arm's problem has its own.
        camera_mask: as in `AbstractRigProblem`.
        free, per_view_free, prior_mean, prior_weight, scale, mesh: as in `AbstractProblem`.
    """

    arms: tuple[ArmInRig, ...]
    camera_mask: Bool[Array, "shared"]
    pixel_sigma: Float[Array, ""]
    free: Int[Array, "free"]
    per_view_free: Bool[Array, "states 6"]
    prior_mean: Step
    prior_weight: Step
    scale: Step
    mesh: Mesh | None = eqx.field(static=True, default=None)

    @property
    def robot_error(self) -> RobotError | None:
        """None, since each arm has an error of its own."""
        return None

    @property
    def parts(self) -> list[Any]:
        """The problems of the arms."""
        return [arm.problem for arm in self.arms]

    @property
    def fitted_aspects(self) -> FittedAspects | None:
        """The cameras whose ratio of focal lengths is fitted in the place of alpha_v."""
        of_arms = []
        for arm in self.arms:
            aspects = arm.problem.fitted_aspects
            if aspects is not None:
                places = np.asarray(arm.parameter_index)[aspects.places]
                of_arms.append(aspects._replace(places=places))
        return joined_aspects(of_arms)

    def start_values(self) -> Float[Array, "shared"]:
        """Return the values of the shared parameters at the start."""
        values = jnp.zeros(self.parameter_count + 6)
        for arm in self.arms:
            of_arm = arm.problem.start_values()
            of_arm = of_arm.at[arm.linked_poses].set(_values_of(arm.first_base_from_linked))
            values = values.at[arm.parameter_index].set(of_arm)
            values = values.at[arm.base_index].set(_values_of(arm.first_base_from_base))
        return values[:-6]

    def host_start_values(self) -> Float[np.ndarray, "shared"]:
        """Return `start_values`, computed with NumPy."""
        values = np.zeros(self.parameter_count + 6)
        for arm in self.arms:
            of_arm, linked = arm.problem.host_start_values(), np.asarray(arm.linked_poses)
            for index, pose in zip(
                linked, np.asarray(arm.first_base_from_linked.wxyz_xyz), strict=True
            ):
                of_arm[index] = [*pose[4:], 0.0, 0.0, 0.0]
            values[np.asarray(arm.parameter_index)] = of_arm
            place = np.asarray(arm.first_base_from_base.wxyz_xyz)[4:]
            values[np.asarray(arm.base_index)] = [*place, 0.0, 0.0, 0.0]
        return values[:-6]

    def with_noise_corrections(self, corrections: Float[np.ndarray, "states 6"]) -> "ArmsProblem":
        """Return the problem with the robots' error fields at poses corrected for noise."""
        arms = [
            with_fields(arm, problem=arm.problem.with_noise_corrections(corrections[rows]))
            for arm, rows in zip(self.arms, self.states_of_arms, strict=True)
        ]
        return with_fields(self, arms=tuple(arms))

    @property
    def host_correction_roots(self) -> Float[np.ndarray, "states 6 6"] | None:
        """The twist of each correction by its own parameters, as in `AbstractProblem`."""
        roots = [arm.problem.host_correction_roots for arm in self.arms]
        if all(of_arm is None for of_arm in roots):
            return None
        states = [len(arm.problem.per_view_free) for arm in self.arms]
        return np.concatenate(
            [
                np.tile(np.eye(6), (count, 1, 1)) if of_arm is None else of_arm
                for of_arm, count in zip(roots, states, strict=True)
            ]
        )

    @property
    def states_of_arms(self) -> tuple[slice, ...]:
        """The rows of each arm's states among all states."""
        ends = np.cumsum([0, *(len(arm.problem.per_view_free) for arm in self.arms)])
        return tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(ends))

    def observation_residuals(self, z: Step) -> tuple[Any, ...]:
        """Return the whitened residuals of each arm's observations."""
        return tuple(arm.problem.observation_residuals(step) for arm, step in self._own_steps(z))

    def chain(self, z: Step) -> tuple[tuple[FittedChain, ...], ...]:
        """Return the chains of each arm's cameras at a scaled step."""
        return tuple(arm.problem.chain(step) for arm, step in self._own_steps(z))

    def normal_equations_without_priors(self, z: Step) -> NormalEquations:
        """Return the normal equations of the observations alone, without priors."""
        size, states = self.parameter_count, len(self.per_view_free)
        cost = jnp.zeros(())
        gradient = Step(jnp.zeros(size), jnp.zeros((states, 6)))
        shared, per_view = jnp.zeros((size, size)), jnp.zeros((states, 6, 6))
        border = jnp.zeros((states, 6, size))
        step = self.unscaled_step(z)
        for (arm, arm_step), rows in zip(self._own_steps(z), self.states_of_arms, strict=True):
            equations = arm.problem.normal_equations_without_priors(arm_step)
            by_all = jax.jacfwd(arm.own_step)(step.shared)
            cost = cost + equations.cost
            gradient = Step(
                gradient.shared + equations.gradient.shared @ by_all,
                gradient.per_view.at[rows].set(equations.gradient.per_view),
            )
            shared = shared + by_all.T @ equations.matrix.shared @ by_all
            per_view = per_view.at[rows].set(equations.matrix.per_view)
            border = border.at[rows].set(equations.matrix.border @ by_all)
        matrix = BlockArrow(shared, border, per_view)
        return self.of_free_parameters(NormalEquations(cost, gradient, matrix))

    def _own_steps(self, z: Step) -> list[tuple[ArmInRig, Step]]:
        """Return each arm with the step of its own parameters at a scaled step."""
        step = self.unscaled_step(z)
        return [
            (arm, Step(arm.own_step(step.shared), step.per_view[rows]))
            for arm, rows in zip(self.arms, self.states_of_arms, strict=True)
        ]


def _values_of(pose: SE3) -> Float[Array, "*batch 6"]:
    """Return the values of a transform's parameters at the start: its translation, no rotation."""
    translation = pose.translation()
    return jnp.concatenate([translation, jnp.zeros_like(translation)], axis=-1)
