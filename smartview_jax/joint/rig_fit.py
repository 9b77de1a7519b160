"""Fit all cameras of a rig together: one robot, one covariance over everything."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from ..argument_checks import require_instance
from ..calibration import Calibration
from ..dataset import Dataset, Rig, chain_residuals, view_residuals
from ..engine import (
    BlockArrow,
    BuiltRig,
    Direction,
    FittedChain,
    Noise,
    NormalEquations,
    Observability,
    Prior,
    ScaledJacobian,
    Solution,
    Step,
    build_rig,
    covariance,
    describe_direction,
    parameter_names,
    per_view_std,
    reduced_equations,
    solve,
)
from ..files import file_transaction
from ..fit_result import FitResult, Rejection
from ..geometry import host_matrices
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.array_namespace import to_device
from ..staged import with_region
from ..variance import RigNoiseEstimate, estimate_rig_noise
from .fit import MAX_INLIER_CHI_SQUARE, solver_result
from .gross_errors import without_views
from .joint_fit import half_width
from .relative_pose import RelativePose, relative_pose
from .rig_rejection import Contradiction, contradiction, suspect_state
from .rig_warnings import rig_warnings
from .saved_estimate import SavedEstimate, uncertainty_to_dict
from .view_rejection import inflation_reason, is_plausible


class RigFit(eqx.Module):
    """The joint fit of all cameras of a rig.

    Attributes:
        calibrations: calibration of each camera, by its name.
        covariance: covariance of the free parameters that all states have in common.
        parameter_names: names of these parameters (see `build_rig`).
        std: standard deviation of each free parameter, by name; of the states' corrections too.
        degrees_of_freedom: degrees of freedom of the common parameters' standard deviations.
        noise: standard deviations of pixels, reported poses and robot errors.
        pixel_sigmas: standard deviation of u and of v of each camera, px.
        noise_estimate: the estimate of the noise; None if the noise was given.
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
    noise: Noise = eqx.field(static=True)
    pixel_sigmas: dict[str, float]
    noise_estimate: RigNoiseEstimate | None
    residuals: dict[str, Float[Array, "views points 2"]]
    inliers: dict[str, Bool[np.ndarray, "views points"]]
    pose_corrections: Float[np.ndarray, "states 6"]
    view_ids: tuple[str, ...] = eqx.field(static=True)
    rejected: tuple[tuple[str, Rejection], ...] = eqx.field(static=True)
    built: BuiltRig
    solution: Solution
    smallest_singular_value: float = eqx.field(static=True)
    result: FitResult = eqx.field(static=True)
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
        robot = self.noise
        lines.append(
            f"robot: {1e3 * robot.translation:.3f} mm and {np.degrees(robot.rotation):.4f} degrees "
            f"of noise in {len(self.view_ids)} states"
        )
        return lines

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
        own, alone = self.built.camera_names[camera], parameter_names(self.built.starts[camera])
        local = dict(zip(own, alone, strict=True))
        kept = [k for k, name in enumerate(self.parameter_names) if name in local]
        names = tuple(local[self.parameter_names[k]] for k in kept)
        covariance = np.asarray(self.covariance)[np.ix_(kept, kept)]
        open_names = [
            name
            for k, name in zip(kept, names, strict=True)
            if not np.isfinite(self.std[self.parameter_names[k]])
        ]
        directions = tuple(
            Direction(0.0, ((name, 1.0),), describe_direction(((name, 1.0),), calibration))
            for name in open_names
        )
        rank, smallest = len(kept) - len(directions), self.smallest_singular_value
        return SavedEstimate(
            calibration,
            covariance,
            names,
            self.noise,
            self.pixel_sigmas[camera],
            Observability(rank, len(kept), directions, (), smallest),
        )

    def relative(self, first: str, second: str) -> RelativePose:
        """Return the pose of the second camera in the frame of the first, with its covariance.

        Args:
            first: name of a camera.
            second: name of a camera with the same mount.

        Raises:
            ValueError: no such camera, or cameras that the robot moves against each other.
        """
        return relative_pose(
            self.calibrations, self.parameter_names, self.covariance, first, second
        )

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
        """Write a calibration file for each camera, `left.yaml`, with its covariance: all or none.

        Each file is read by `Calibration.load` and `load_estimate`.

        Args:
            folder: of the files; created if it does not exist.
            run: name of the run that made them; None without one.
            pictures: digests of each camera's pictures, by its name, so that they are known again.
        """
        names = tuple(f"{name}.yaml" for name in self.calibrations)
        with file_transaction(folder, names) as place:
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
    noise: str | Noise = "estimated",
    field: FieldChoice = "auto",
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
    rejected: Sequence[tuple[str, Rejection]] = (),
) -> RigFit:
    """Fit all cameras of a rig, their targets and the robot's errors to all pixels at once.

    Args:
        rig: data sets of the cameras.
        starts: calibration of each camera near the solution, with the lens to fit. Cameras that see
            the same target must agree on its pose (`calibrate` takes care of it).
        noise: `"estimated"`, or a `Noise` that states the standard deviations.
        field: robot error field, as in `fit_joint`.
        fixed: paths of parameters that keep the start's value: `left.camera`, `base_from_world`.
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
    field, left_out = checked_field_choice(field), list(rejected)
    if noise != "estimated" and not isinstance(noise, Noise):
        raise ValueError(f'noise is "estimated" or a Noise for a rig; found {noise!r}')

    def fit_once(rig: Rig) -> _Solved:
        built, start, estimate = _built(
            rig, starts, noise, field, fixed, free, priors, progress, robot_prior
        )
        if progress is not None:
            count = sum(int(np.asarray(data.visible).sum()) for data in rig.cameras.values())
            shared = len(built.shared_names)
            progress(f"joint fit of the rig: {shared} shared parameters, {count} points")
        return _Solved(rig, built, estimate, *solve(built.problem, start=start))

    # The noise is estimated again without a wrong pose, since one inflates it for all states.
    found = fit_once(rig)
    while (estimate := found.estimate) is not None:
        wrong = contradiction(*found.at_optimum)
        if wrong is not None:
            found = fit_once(_without(found.rig, wrong))
        else:
            # One wrong pose may inflate the noise so much that no state fails the test.
            plausible = is_plausible(estimate.noise, robot_prior or RobotPrior())
            suspect = None if plausible else suspect_state(*found.at_optimum)
            if suspect is None:
                break
            refitted = fit_once(_without(found.rig, suspect))
            assert refitted.estimate is not None
            reason = inflation_reason(estimate.noise, refitted.estimate.noise)
            if reason is None:
                break
            found, wrong = refitted, suspect._replace(reason=reason)
        left_out += [(name, Rejection(wrong.view_id, None, wrong.reason)) for name in wrong.cameras]
    fit = _assembled(found, tuple(left_out))
    return dataclasses.replace(fit, warnings=rig_warnings(fit, robot_prior or RobotPrior()))


class _Solved(NamedTuple):
    """A rig, its problem, and the problem's solution."""

    rig: Rig
    built: BuiltRig
    estimate: RigNoiseEstimate | None
    solution: Solution
    equations: NormalEquations

    @property
    def at_optimum(self) -> tuple[Rig, BuiltRig, Step, BlockArrow]:
        """The arguments of `contradiction` and `suspect_state`."""
        return self.rig, self.built, self.solution.z, self.equations.matrix


def _built(
    rig: Rig,
    starts: Mapping[str, Calibration],
    noise: str | Noise,
    field: FieldChoice,
    fixed: Sequence[str],
    free: Sequence[str],
    priors: Mapping[str, Prior] | None,
    progress: Callable[[str], None] | None,
    robot_prior: RobotPrior | None,
) -> tuple[BuiltRig, Step, RigNoiseEstimate | None]:
    """Build the problem, with estimated noise unless it is given; return the first step too."""
    if isinstance(noise, Noise):
        given = None if field == "auto" else field
        built = build_rig(
            rig, starts, noise=noise, field=given, fixed=fixed, free=free, priors=priors
        )
        return built, built.problem.zero_step(), None
    estimate = estimate_rig_noise(
        rig,
        starts,
        field=field,
        fixed=fixed,
        free=free,
        priors=priors,
        progress=progress,
        robot_prior=robot_prior,
    )
    return estimate.built, estimate.step, estimate


def _without(rig: Rig, wrong: Contradiction) -> Rig:
    """Return the rig without some cameras' views of a state."""
    cameras = dict(rig.cameras)
    for name in wrong.cameras:
        view = cameras[name].view_ids.index(wrong.view_id)
        cameras[name] = without_views(cameras[name], {view: wrong.reason})
    return Rig(cameras, rig.targets)


def _assembled(found: _Solved, rejected: tuple[tuple[str, Rejection], ...]) -> RigFit:
    """Build the result: calibrations, covariance and inliers at the solution."""
    rig, built, estimate, solution, equations = found
    reduced = reduced_equations(equations.matrix)
    norms = np.sqrt(np.diagonal(np.asarray(equations.matrix.shared)))
    jacobian = ScaledJacobian(reduced.schur_complement, norms)
    # The noise is stated or estimated: the variance factor is one.
    common, std = covariance(jacobian, 1.0)
    freedom = np.full(len(std), np.inf)
    if estimate is not None:
        added = estimate.small_sample_correction.added_covariance
        added = added + estimate.between_models_covariance
        common, freedom = common + added, estimate.small_sample_correction.degrees_of_freedom
        std = np.sqrt(std**2 + np.diagonal(added))
    of_states = per_view_std(reduced, common, 1.0)[np.asarray(built.problem.per_view_free)]
    sigma = float(built.problem.pixel_sigma)
    relative = {} if estimate is None else estimate.relative_sigmas
    calibrations, residuals, inliers = {}, {}, {}
    for name, chain in _chains(built, solution).items():
        data, calibration = rig.cameras[name], chain.calibration
        if estimate is not None and (error := calibration.robot_error) is not None:
            fitted = None if estimate.field is None else error.converted_to(estimate.field)
            calibration = dataclasses.replace(calibration, robot_error=fitted)
        own = _residuals_at(chain, data)
        gate = MAX_INLIER_CHI_SQUARE * (sigma * relative.get(name, 1.0)) ** 2
        inliers[name] = np.asarray(data.visible) & (np.sum(own**2, axis=-1) <= gate)
        residuals[name] = chain_residuals(calibration, data.observations)
        calibrations[name] = with_region(calibration, data)
    return RigFit(
        calibrations=calibrations,
        covariance=common,
        parameter_names=built.shared_names,
        std=dict(
            zip((*built.shared_names, *built.per_view_names), (*std, *of_states), strict=True)
        ),
        degrees_of_freedom=dict(zip(built.shared_names, map(float, freedom), strict=True)),
        noise=built.noise if estimate is None else estimate.noise,
        pixel_sigmas={name: sigma * relative.get(name, 1.0) for name in rig.cameras},
        noise_estimate=estimate,
        residuals=residuals,
        inliers=inliers,
        pose_corrections=np.asarray(solution.z.per_view),
        view_ids=rig.view_ids,
        rejected=rejected,
        built=built,
        solution=solution,
        smallest_singular_value=float(jacobian.singular_values[-1]),
        result=solver_result(solution),
    )


def _residuals_at(chain: FittedChain, data: Dataset) -> Float[np.ndarray, "views points 2"]:
    """Return measured minus predicted pixels at a fit, with all corrections."""
    camera, size = chain.calibration.camera, chain.calibration.target_scale
    poses = np.asarray(chain.camera_from_world)[: data.view_count]
    return np.asarray(view_residuals(camera, size, poses, data.observations))


def _chains(built: BuiltRig, solution: Solution) -> dict[str, FittedChain]:
    """Return the chain of each camera, by its name."""
    return {
        name: jax.tree.map(lambda x, row=row: to_device(np.asarray(x)[row]), chains)
        for cameras, chains in zip(built.cameras, solution.chain, strict=True)
        for row, name in enumerate(cameras)
    }
