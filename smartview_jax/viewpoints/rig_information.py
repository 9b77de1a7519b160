"""Compute the information that states of a rig's robot carry about all of its cameras.

In one state every camera sees its target with the same error of the robot's pose. With this error
marginalised, every state has its own information matrix for the parameters of all cameras, and the
matrices of states add up, as the matrices of a single camera's views do.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Unpack

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..argument_checks import errors_at, require_instance
from ..calibration import Calibration
from ..dataset import Dataset, Observations, Rig, chain_residuals
from ..engine import (
    BuiltRig,
    Noise,
    ParameterOptions,
    RigProblem,
    Step,
    build_rig,
    inverse_of_covariance,
    is_aspect,
)
from ..joint import RigEstimate, RigFit
from ..robot_errors import FieldChoice, nominal_arm
from ..robots import Command, CommandLike, as_command
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled_optimised


@dataclasses.dataclass(frozen=True, eq=False)
class RigInformationModel:
    """A model of a rig and of its error sizes, which gives the information of robot states.

    Attributes:
        rig: data sets of the cameras, for their targets and their arm.
        calibrations: calibration of each camera at which states are linearised, by its name.
        build: function from a rig with any states to its least-squares problem.
        prior_information: information matrix that is available without any state.
        parameter_names: names of the free parameters, in the order of all matrices here.
    """

    rig: Rig
    calibrations: Mapping[str, Calibration]
    build: Callable[[Rig], BuiltRig]
    prior_information: Float[Array, "free free"]
    parameter_names: tuple[str, ...]

    @classmethod
    def from_calibrations(
        cls,
        calibrations: Mapping[str, Calibration],
        rig: Rig,
        noise: Noise,
        *,
        field: FieldChoice = "auto",
        **parameters: Unpack[ParameterOptions],
    ) -> "RigInformationModel":
        """Return a model from the same arguments as a fit or a Cramer-Rao bound of the rig.

        Args:
            calibrations: the true calibration of each camera as far as it is known.
            rig: data sets of the cameras, for their targets; their views add no information.
            noise: sizes of all errors.
            field: robot error field; by default the calibrations' own error is taken as known.
            parameters: `fixed`, paths of known parameters, and `free` as in `fit_rig`; `priors`,
                the knowledge before any state.

        Raises:
            TypeError: an argument of a wrong type.
            ValueError: as for `build_rig`.
        """
        require_instance("rig", rig, Rig)
        require_instance("noise", noise, Noise)
        build = functools.partial(
            build_rig,
            starts=calibrations,
            noise=noise,
            field=field,
            **parameters,
        )
        built = build(rig)
        prior = to_device(built.problem.host_prior_information())
        # The information of all views is by the parameters as they are named.
        priors = parameters.get("priors") or {}
        build = functools.partial(
            build, priors={path: priors[path] for path in priors if not is_aspect(path)}
        )
        return cls(rig, dict(calibrations), build, prior, built.shared_names)

    @classmethod
    def from_fit(cls, fit: RigFit, rig: Rig, arm: str | None = None) -> "RigInformationModel":
        """Return a model whose knowledge before any further state is the covariance of a fit.

        Args:
            arm: name of one of several arms, whose states are to be planned for its own cameras.

        Raises:
            ValueError: the fit leaves a parameter undetermined, or the rig has several arms and
                none of them is named.
        """
        if arm is None:
            rig.require_one_arm("RigInformationModel")
        with errors_at("fit"):
            estimate = RigEstimate.of(fit, arm)
        part = rig if arm is None else rig.of_arm(arm)
        sigmas = {name: fit.pixel_sigmas[name] for name in part.cameras}
        return cls.from_estimate(estimate, part, sigmas)

    @classmethod
    def from_estimate(
        cls, estimate: RigEstimate, rig: Rig, pixel_sigmas: Mapping[str, float]
    ) -> "RigInformationModel":
        """Return a model whose knowledge before any further state is the covariance of an estimate.

        Args:
            estimate: the calibrations of the cameras with their joint covariance.
            rig: the data sets, for their targets and their arm.
            pixel_sigmas: standard deviation of u and of v of each camera, px.

        Raises:
            ValueError: the rig has several arms, or other cameras than the estimate.
        """
        rig.require_one_arm("RigInformationModel")
        error = next(iter(estimate.calibrations.values())).robot_error
        # All knowledge of the robot's error is in the covariance; no other prior applies.
        field = None if error is None else error.field
        build = functools.partial(
            build_rig,
            starts=estimate.calibrations,
            noise=estimate.noise.with_unit_groups(field),
            field=field,
            relative_sigmas={
                name: sigma / estimate.noise.pixel for name, sigma in pixel_sigmas.items()
            },
        )
        known = set(build(rig).shared_names) - set(estimate.parameter_names)
        build = functools.partial(build, fixed=tuple(known), free=estimate.parameter_names)
        names = build(rig).shared_names
        order = [estimate.parameter_names.index(name) for name in names]
        covariance = np.asarray(estimate.covariance)[np.ix_(order, order)]
        information = inverse_of_covariance(covariance)
        return cls(rig, estimate.calibrations, build, to_device(information), names)

    @property
    def mounts(self) -> dict[str, str]:
        """The path of each camera's hand-eye transform, by the camera's name."""
        return {name: f"{name}.{c.transform_names[0]}" for name, c in self.calibrations.items()}

    def planned(self, states: CommandLike, border_margin: float = 0.0) -> Rig:
        """Return the rig that would be seen in other states of the robot, without any noise.

        Args:
            states: commands `(states)` of the robot: poses `base_from_tool`, or a `Command` with
                joint readings if the calibrations correct an arm's errors.
            border_margin: smallest distance from the picture's border of a point that is seen, px.

        Raises:
            ValueError: poses alone for calibrations that correct an arm's errors.
        """
        command = as_command(states)
        error = next(iter(self.calibrations.values())).robot_error
        if command.joints is None and error is not None and nominal_arm(error.field) is not None:
            raise ValueError(
                "states: the calibrations correct errors of an arm's joints: give commands with "
                "joint readings, as from SerialArm.command"
            )
        cameras = {name: self._seen_by(name, command, border_margin) for name in self.calibrations}
        return Rig(cameras, self.rig.targets)

    def _seen_by(self, camera: str, command: Command, border_margin: float) -> Dataset:
        """Return what one camera would see."""
        calibration, data = self.calibrations[camera], self.rig.cameras[camera]
        points = np.asarray(data.points)[0]
        shape = (len(np.asarray(command.base_from_tool.wxyz_xyz)), len(points))
        # Minus the residuals at pixels of zero; so the program of the fits is used again.
        observations = Observations(
            to_device(np.broadcast_to(points, (*shape, 3))),
            to_device(np.zeros((*shape, 2))),
            to_device(np.ones(shape, dtype=bool)),
            command.base_from_tool,
            command.joints,
        )
        pixels = -np.asarray(chain_residuals(calibration, observations))
        # Pixel centres are at 0, 1, ..., width - 1.
        last = np.array(data.image_size) - 1.0
        inside = (pixels >= border_margin) & (pixels <= last - border_margin)
        seen = Dataset.from_arrays(
            points,
            np.where(inside.all(axis=-1, keepdims=True), pixels, np.nan),
            command.base_from_tool if command.joints is None else None,
            data.image_size,
            mount=data.mount,
            joints=command.joints,
            arm=None if command.joints is None else self.rig.arm,
        )
        if data.depth_noise is None:
            return seen
        poses = np.asarray(calibration.camera_from_world_matrices(command))
        in_camera = float(calibration.target_scale) * points @ poses[:, :3, :3].mT
        depths = in_camera[..., 2] + poses[:, None, 2, 3]
        return seen.with_depths(
            np.where(np.asarray(seen.visible), depths, np.nan), data.depth_noise
        )

    def information(self, rig: Rig) -> Float[Array, "states free free"]:
        """Return the information matrix of every state of a rig with this rig's cameras."""
        problem = self.build(rig).problem
        # F_s = A_s - B_s^T D_s^-1 B_s, summed over cameras before the state's own correction is
        # eliminated, so that cameras which share a state share its error.
        return _information_by_state(problem)[1]

    def pixel_moment_matrix(self, rig: Rig) -> Float[Array, "free free"]:
        """Return the mean squared displacement of pixels by the parameters, as a matrix.

        `step @ pixel_moment_matrix @ step` is the mean over all points that all cameras see of the
        squared displacement, u and v together, px^2, to first order.
        """
        problem = self.build(rig).problem
        # With a pixel sigma of 1 px the information J^T J of the pixels is the sum of squares.
        problem = eqx.tree_at(
            lambda p: (p.pixel_sigma, *(group.problems.pixel_sigma for group in p.groups)),
            problem,
            replace_fn=lambda sigma: to_device(np.ones(sigma.shape)),
        )
        # Depths are no pixels: they do not count.
        problem = eqx.tree_at(
            lambda p: [
                group.problems.observations.depths.precision
                for group in p.groups
                if group.problems.observations.depths is not None
            ],
            problem,
            replace_fn=jnp.zeros_like,
        )
        shared, _ = _information_by_state(problem)
        return jnp.sum(shared, axis=0) / max(problem.visible_count, 1)


@compiled_optimised
def _information_by_state(
    problem: RigProblem,
) -> tuple[Float[Array, "states free free"], Float[Array, "states free free"]]:
    """Return each state's matrix of the shared parameters, and with its correction eliminated."""
    free, states = problem.free.shape, problem.per_view_free.shape
    blocks = problem.blocks_by_view(Step(jnp.zeros(free), jnp.zeros(states)))
    return blocks.shared, problem.without_corrections(blocks)
