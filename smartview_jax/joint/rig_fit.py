"""Fit all cameras and arms of a rig together: one covariance over everything."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..argument_checks import require_instance, require_names
from ..calibration import Calibration
from ..dataset import Dataset, Rig, chain_residuals, view_residuals
from ..engine import (
    BuiltArms,
    BuiltRig,
    Direction,
    FittedChain,
    Noise,
    Observability,
    Prior,
    ScaledJacobian,
    Solution,
    base_path,
    covariance,
    describe_direction,
    parameter_names,
    paths_of_arms,
    per_view_std,
    reduced_equations,
)
from ..files import file_transaction
from ..fit_result import FitResult, Rejection
from ..geometry import host_matrices
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.array_namespace import to_device
from ..staged import with_region
from ..variance import RigNoiseEstimate
from .arm_fit import ArmOptions, SolvedArm, fit_arm
from .fit import MAX_INLIER_CHI_SQUARE, solver_result
from .joint_fit import half_width
from .relative_pose import RelativePose, relative_base, relative_pose
from .rig_estimate import RIG_FILE, save_rig
from .rig_warnings import rig_warnings
from .saved_estimate import SavedEstimate, uncertainty_to_dict
from .several_arms import JoinedArms, added_by_estimation, join_arms, own_jacobians

_Option = TypeVar("_Option")


class RigFit(eqx.Module):
    """The joint fit of all cameras of a rig.

    Attributes:
        calibrations: calibration of each camera, by its name.
        covariance: covariance of the free parameters that all states have in common.
        parameter_names: names of these parameters (see `build_rig`).
        std: standard deviation of each free parameter, by name; of the states' corrections too.
        degrees_of_freedom: degrees of freedom of the common parameters' standard deviations.
        noises: standard deviations of pixels, reported poses and robot errors, by the arm's name.
        pixel_sigmas: standard deviation of u and of v of each camera, px.
        noise_estimates: the estimate of the noise of each arm; empty if the noise was given.
        residuals: measured minus predicted pixels of each camera through the chain without
            corrections of single states, px; zero where not seen.
        inliers: observations of each camera within the chi-square gate around the fit.
        pose_corrections: twist at the tool of each state, translation (m) and rotation (rad).
        view_ids: names of the states.
        rejected: observations that were left out, each with its camera.
        built: the least-squares problem, with the names of its parameters.
        solution: the final step, with iterations and costs.
        smallest_singular_value: of the Jacobian with unit columns; small for data that hardly
            determine a parameter.
        result: whether the fit converged.
        bases: transform from each arm's base to the base of the first; empty for one arm.
        arms: name of the arm of each camera.
        warnings: reasons to doubt the result, a sentence each.

    For example, with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> both = sv.fit_rig(rig, {"left": truth, "right": truth}, noise=noise)
        >>> print(sorted(both.calibrations), both.pose_corrections.shape)  # one for each state
        ['left', 'right'] (8, 6)
    """

    calibrations: dict[str, Calibration]
    covariance: Float[np.ndarray, "free free"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    std: dict[str, float]
    degrees_of_freedom: dict[str, float]
    noises: dict[str, Noise] = eqx.field(static=True)
    pixel_sigmas: dict[str, float]
    noise_estimates: dict[str, RigNoiseEstimate]
    residuals: dict[str, Float[Array, "views points 2"]]
    inliers: dict[str, Bool[np.ndarray, "views points"]]
    pose_corrections: Float[np.ndarray, "states 6"]
    view_ids: tuple[str, ...] = eqx.field(static=True)
    rejected: tuple[tuple[str, Rejection], ...] = eqx.field(static=True)
    built: BuiltRig | BuiltArms
    solution: Solution
    smallest_singular_value: float = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)
    bases: dict[str, SE3]
    arms: dict[str, str] = eqx.field(static=True)
    warnings: tuple[str, ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        return f"<RigFit of {', '.join(self.calibrations)}: {self.result.message}>"

    def __str__(self) -> str:
        return "\n".join([self.result.message, *self._lines(), *self.warnings])

    def _lines(self) -> list[str]:
        """Return a line for each camera, and one for the robot."""
        lines = []
        for name, calibration in self.calibrations.items():
            mount = f"{name}.{calibration.transform_names[0]}"
            places, turns = (
                [self.std.get(f"{mount}.{part}.{axis}", 0.0) for axis in "xyz"]
                for part in ("translation", "rotation")
            )
            x, y, z = 1e3 * host_matrices(calibration.camera_from_mount)[:3, 3]
            lines += [
                f"{mount}: {x:.2f}, {y:.2f}, {z:.2f} mm",
                f"  +- {1e3 * np.hypot.reduce(places):.2f} mm and "
                f"{np.degrees(np.hypot.reduce(turns)):.3f} degrees; {self.rms(name):.3f} px RMS",
            ]
        for arm, built in self.built_by_arm.items():
            robot, states = self.noises[arm], len(built.problem.per_view_free)
            lines.append(
                f"{arm if self.bases else 'robot'}: {1e3 * robot.translation:.3f} mm and "
                f"{np.degrees(robot.rotation):.4f} degrees of noise in {states} states"
            )
        for name, base in self._named_bases():
            x, y, z = 1e3 * host_matrices(base.transform)[:3, 3]
            lines += [
                f"{name}: {x:.2f}, {y:.2f}, {z:.2f} mm",
                f"  +- {1e3 * np.hypot.reduce(base.std[:3]):.2f} mm and "
                f"{np.degrees(np.hypot.reduce(base.std[3:])):.3f} degrees",
            ]
        return lines

    @property
    def noise(self) -> Noise:
        """The standard deviations of pixels, reported poses and robot errors of the only arm.

        Raises:
            ValueError: there are several arms, which have `noises`.
        """
        return self.noises[self._only_arm("noises")]

    @property
    def noise_estimate(self) -> RigNoiseEstimate | None:
        """The estimate of the noise of the only arm; None if the noise was given.

        Raises:
            ValueError: there are several arms, which have `noise_estimates`.
        """
        return self.noise_estimates.get(self._only_arm("noise_estimates"))

    def _only_arm(self, name: str) -> str:
        """Return the name of the only arm."""
        if len(self.noises) > 1:
            raise ValueError(f"this rig has the arms {', '.join(self.noises)}: take {name}[...]")
        return next(iter(self.noises))

    @property
    def built_by_arm(self) -> dict[str, BuiltRig]:
        """The problem of each arm alone, by its name."""
        if isinstance(self.built, BuiltRig):
            return {next(iter(self.noises)): self.built}
        return self.built.arms

    def rms(self, camera: str) -> float:
        """Return the RMS length of a camera's residuals over its inliers, px."""
        residuals = np.asarray(self.residuals[camera])[np.asarray(self.inliers[camera])]
        return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1)))) if len(residuals) else np.nan

    def estimate(self, camera: str) -> SavedEstimate:
        """Return one camera's calibration with its covariance, for all that works with a fit.

        Raises:
            ValueError: there is no such camera.
        """
        calibration = self.calibrations[self._checked(camera)]
        built = self.built_by_arm[self.arms[camera]]
        names, known, std = self._of_arm(self.arms[camera])
        own, alone = built.camera_names[camera], parameter_names(built.starts[camera])
        local = dict(zip(own, alone, strict=True))
        kept = [k for k, name in enumerate(names) if name in local]
        open_names = [local[names[k]] for k in kept if not np.isfinite(std[k])]
        directions = tuple(
            Direction(0.0, ((name, 1.0),), describe_direction(((name, 1.0),), calibration))
            for name in open_names
        )
        rank, smallest = len(kept) - len(directions), self.smallest_singular_value
        noise, sigma = self.noises[self.arms[camera]], self.pixel_sigmas[camera]
        white = noise.white_pixel
        if white is not None:
            white *= sigma / noise.pixel
        return SavedEstimate(
            calibration,
            known[np.ix_(kept, kept)],
            tuple(local[names[k]] for k in kept),
            dataclasses.replace(noise, pixel=sigma, white_pixel=white),
            sigma,
            Observability(rank, len(kept), directions, (), smallest),
        )

    def _of_arm(
        self, arm: str
    ) -> tuple[tuple[str, ...], Float[np.ndarray, "own own"], Float[np.ndarray, "own"]]:
        """Return the names of one arm's free parameters, their covariance and standard deviations.

        Poses of targets are in the arm's base.
        """
        common = np.asarray(self.covariance)
        std = np.array([self.std[name] for name in self.parameter_names])
        if isinstance(self.built, BuiltRig):
            return self.parameter_names, common, std
        jacobian = own_jacobians(self.built, self.solution)[arm]
        own = jacobian @ common @ jacobian.T
        # A parameter is as little determined as those that it depends on.
        is_open = (jacobian != 0.0) @ ~np.isfinite(std)
        return (
            self.built.arms[arm].shared_names,
            own,
            np.where(is_open, np.inf, np.sqrt(np.diagonal(own))),
        )

    def relative(self, first: str, second: str) -> RelativePose:
        """Return the pose of the second camera in the frame of the first, with its covariance.

        Args:
            first: name of a camera.
            second: name of a camera with the same mount.

        Raises:
            ValueError: no such camera, or cameras that a robot moves against each other.
        """
        if self.arms[self._checked(first)] != self.arms[self._checked(second)]:
            raise ValueError(
                f"relative: camera {first!r} is on arm {self.arms[first]!r} and {second!r} on "
                f"{self.arms[second]!r}: their relative pose changes with the robots'; use `base` "
                "and their `camera_from_world`"
            )
        return relative_pose(
            self.calibrations, self.parameter_names, self.covariance, first, second
        )

    def base(self, first: str, second: str) -> RelativePose:
        """Return the pose of the second arm's base in the base of the first, with its covariance.

        It tells where both arms are to each other, from the targets that both see.

        Args:
            first: name of an arm.
            second: name of an arm.

        Raises:
            ValueError: no such arm, or the rig has only one.
        """
        if not self.bases:
            raise ValueError(f"base: the rig has one arm, {next(iter(self.noises))!r}")
        return relative_base(self.bases, self.parameter_names, self.covariance, first, second)

    def confidence_half_width(self, name: str, level: float = 0.95) -> float:
        """Return the half width of a parameter's confidence interval, in its own unit.

        Args:
            name: as in `parameter_names`.
            level: probability that the interval contains the true value.
        """
        return half_width(self.std[name], self.degrees_of_freedom[name], level)

    def save(
        self,
        folder: str | os.PathLike[str],
        run: str | None = None,
        pictures: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """Write a calibration file for each camera, `left.yaml`, and their joint covariance.

        Each camera's file has its own covariance and is read by `Calibration.load` and
        `load_estimate`; `rig.joint.yaml` has the joint covariance, for `load_rig_estimate`. Of
        several arms, the pose of every other base in the first one is written in its place, such
        as base_left_from_base_right.yaml, which `RelativePose.load` reads. All are written, or
        none.

        Args:
            folder: of the files; created if it does not exist.
            run: name of the run that made them; None without one.
            pictures: digests of each camera's pictures, by its name, so that they are known again.
        """
        with file_transaction(folder, self.file_names) as place:
            for name in self.calibrations:
                estimate = self.estimate(name)
                estimate.calibration.save(
                    place / f"{name}.yaml",
                    run,
                    warnings=self.warnings,
                    source=f"rig of {', '.join(self.calibrations)}",
                    uncertainty=uncertainty_to_dict(estimate),
                    pictures=(pictures or {}).get(name, ()),
                )
            for name, base in self._named_bases():
                base.save(place / f"{name}.yaml", run)
            if len(self.noises) == 1:
                save_rig(self, place, run)

    @property
    def file_names(self) -> tuple[str, ...]:
        """The names of the files that `save` writes."""
        stems = (*self.calibrations, *(path for path, _ in self._named_bases()))
        joint = (RIG_FILE,) if len(self.noises) == 1 else ()
        return (*(f"{stem}.yaml" for stem in stems), *joint)

    def _named_bases(self) -> list[tuple[str, RelativePose]]:
        """Return the pose of every other base in the base of the first arm, by its name."""
        names = tuple(self.bases)
        return [(base_path(names[0], arm), self.base(names[0], arm)) for arm in names[1:]]

    def _checked(self, camera: str) -> str:
        """Return a camera's name, which must be known."""
        if camera not in self.calibrations:
            raise ValueError(
                f"expected a camera of {', '.join(self.calibrations)}, found {camera!r}"
            )
        return camera


def fit_rig(
    rig: Rig,
    starts: Mapping[str, Calibration],
    *,
    noise: str | Noise | Mapping[str, Noise] = "estimated",
    field: FieldChoice | Mapping[str, FieldChoice] = "auto",
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
    rejected: Sequence[tuple[str, Rejection]] = (),
) -> RigFit:
    """Fit all cameras of a rig, their targets and the robots' errors to all pixels at once.

    The noise and the errors of several arms are estimated one arm after the other, each from its
    own states; then all are fitted together.

    Args:
        rig: data sets of the cameras.
        starts: calibration of each camera near the solution, with the lens to fit. Cameras on one
            arm that see the same target must agree on its pose (`calibrate` takes care of it).
        noise: `"estimated"`, or a `Noise` that states the standard deviations; of several arms, one
            for all or one for each by its name.
        field: robot error field, as in `fit_joint`; of several arms, one for all or one for each.
        fixed: paths of parameters that keep the start's value: `left.camera`, `base_from_world`.
            See `build_rig`, and `build_arms` for several arms.
        free: paths to free that are held by default: `target_scale`.
        priors: a `Prior` by path.
        progress: called with a line of text for each stage.
        robot_prior: prior on the sizes of the robot's errors.
        rejected: what was left out before, for the result.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: an unknown path, or a start at which no point of a view can be projected.

    For example, with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> both = sv.fit_rig(rig, {"left": truth, "right": truth}, noise=noise)
        >>> std = both.relative("left", "right").std
        >>> print(f"{1e3 * std[2]:.1f} mm along the optical axis")
        0.9 mm along the optical axis
    """
    require_instance("rig", rig, Rig)
    require_names("fixed", fixed)
    require_names("free", free)
    known, prior = dict(priors or {}), robot_prior or RobotPrior()
    several, arms = len(rig.arm_names) > 1, {}
    paths = paths_of_arms(rig, starts, fixed, free, known)
    for arm in rig.arm_names:
        own_noise = _option_of(arm, "noise", noise)
        if own_noise != "estimated" and not isinstance(own_noise, Noise):
            raise ValueError(f'noise is "estimated" or a Noise for a rig; found {own_noise!r}')
        own_field = checked_field_choice(_option_of(arm, "field", field))
        arms[arm] = fit_arm(
            rig.of_arm(arm),
            {name: start for name, start in starts.items() if rig.arms.get(name, arm) == arm},
            ArmOptions(own_noise, own_field, paths[arm], prior),
            _named(progress, arm) if several else progress,
        )
    joined = join_arms(rig, arms, known) if several else None
    fit = _assembled(rig, arms, joined, tuple(rejected))
    disagreement = () if joined is None else joined.disagreement
    return dataclasses.replace(fit, warnings=(*rig_warnings(fit, prior), *disagreement))


def _named(progress: Callable[[str], None] | None, arm: str) -> Callable[[str], None] | None:
    """Return a function that reports progress with the arm's name."""
    return None if progress is None else lambda text: progress(f"{arm}: {text}")


def _option_of(arm: str, name: str, option: _Option | Mapping[str, _Option]) -> _Option:
    """Return an option for one arm, of a value for all arms or of one for each.

    Raises:
        ValueError: the arm has no value.
    """
    if not isinstance(option, Mapping):
        return option
    if arm not in option:
        raise ValueError(f"{name}: expected a value for arm {arm!r}, found {', '.join(option)}")
    return option[arm]


def _assembled(
    rig: Rig,
    arms: Mapping[str, SolvedArm],
    joined: JoinedArms | None,
    rejected: tuple[tuple[str, Rejection], ...],
) -> RigFit:
    """Build the result: calibrations, covariance and inliers at the solution.

    Args:
        rig: data sets of all arms.
        arms: the fit of each arm alone.
        joined: the fit of all arms; None if there is one.
        rejected: what was left out before.
    """
    first = next(iter(arms.values()))
    together = joined or first
    built, solution, equations = together.built, together.solution, together.equations
    reduced = reduced_equations(equations.matrix)
    norms = np.sqrt(np.diagonal(np.asarray(equations.matrix.shared)))
    jacobian = ScaledJacobian(reduced.schur_complement, norms)
    # The noise is stated or estimated: the variance factor is one.
    common, std = covariance(jacobian, 1.0)
    freedom = np.full(len(std), np.inf)
    estimated = (
        _added_by_estimation(first) if joined is None else added_by_estimation(joined, arms, common)
    )
    if estimated is not None:
        added, freedom = estimated
        common = common + added
        std = np.sqrt(std**2 + np.diagonal(added))
    of_states = per_view_std(reduced, common, 1.0)[np.asarray(built.problem.per_view_free)]
    calibrations, residuals, inliers, pixel_sigmas = {}, {}, {}, {}
    chains = (solution.chain,) if joined is None else solution.chain
    for arm, of_cameras in zip(arms.values(), chains, strict=True):
        sigma = float(arm.built.problem.pixel_sigma)
        estimate = arm.estimate
        relative = {} if estimate is None else estimate.relative_sigmas
        for name, chain in _chains(arm.built, of_cameras).items():
            data, calibration = arm.rig.cameras[name], chain.calibration
            if estimate is not None and (error := calibration.robot_error) is not None:
                fitted = None if estimate.field is None else error.converted_to(estimate.field)
                calibration = dataclasses.replace(calibration, robot_error=fitted)
            own = _residuals_at(chain, data)
            pixel_sigmas[name] = sigma * relative.get(name, 1.0)
            gate = MAX_INLIER_CHI_SQUARE * pixel_sigmas[name] ** 2
            inliers[name] = np.asarray(data.visible) & (np.sum(own**2, axis=-1) <= gate)
            residuals[name] = chain_residuals(calibration, data.observations)
            calibrations[name] = with_region(calibration, data)
    left_out = [entry for arm in arms.values() for entry in arm.rejected]
    return RigFit(
        calibrations=calibrations,
        covariance=common,
        parameter_names=built.shared_names,
        std=dict(
            zip((*built.shared_names, *built.per_view_names), (*std, *of_states), strict=True)
        ),
        degrees_of_freedom=dict(zip(built.shared_names, map(float, freedom), strict=True)),
        noises={
            name: arm.built.noise if arm.estimate is None else arm.estimate.noise
            for name, arm in arms.items()
        },
        pixel_sigmas=pixel_sigmas,
        noise_estimates={
            name: arm.estimate for name, arm in arms.items() if arm.estimate is not None
        },
        residuals=residuals,
        inliers=inliers,
        pose_corrections=np.asarray(solution.z.per_view),
        view_ids=rig.view_ids,
        rejected=(*rejected, *left_out),
        built=built,
        solution=solution,
        smallest_singular_value=float(jacobian.singular_values[-1]),
        result=solver_result(solution),
        bases={} if joined is None else joined.bases,
        arms={camera: name for name, arm in arms.items() for camera in arm.rig.cameras},
    )


def _added_by_estimation(
    arm: SolvedArm,
) -> tuple[Float[np.ndarray, "free free"], Float[np.ndarray, "free"]] | None:
    """Return what estimated noise adds to one arm's covariance, and the degrees of freedom."""
    if arm.estimate is None:
        return None
    correction = arm.estimate.small_sample_correction
    added = correction.added_covariance + arm.estimate.between_models_covariance
    return added, correction.degrees_of_freedom


def _residuals_at(chain: FittedChain, data: Dataset) -> Float[np.ndarray, "views points 2"]:
    """Return measured minus predicted pixels at a fit, with all corrections."""
    camera, size = chain.calibration.camera, chain.calibration.target_scale
    poses = np.asarray(chain.camera_from_world)[: data.view_count]
    return np.asarray(view_residuals(camera, size, poses, data.observations))


def _chains(built: BuiltRig, of_groups: tuple[FittedChain, ...]) -> dict[str, FittedChain]:
    """Return the chain of each camera, by its name."""
    return {
        name: jax.tree.map(lambda x, row=row: to_device(np.asarray(x)[row]), chains)
        for cameras, chains in zip(built.cameras, of_groups, strict=True)
        for row, name in enumerate(cameras)
    }
