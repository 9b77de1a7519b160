"""Hold the joint fit of a rig: calibrations of all cameras and arms, with one covariance."""

import dataclasses
import os
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

import smartview_jax as sv

from ..calibration import Calibration
from ..dataset import DepthSensor, Rig, arms_of
from ..engine import (
    BuiltArms,
    BuiltRig,
    Direction,
    Noise,
    Observability,
    Solution,
    base_path,
    describe_direction,
    parameter_names,
)
from ..files import file_transaction
from ..fit_result import FitResult, Rejection
from ..geometry import host_matrices
from ..variance import RigNoiseEstimate, SmallSampleCorrection
from .joint_fit import half_width
from .open_directions import OpenDirections, any_changed
from .relative_pose import RelativePose, RigUncertainty, relative_base, relative_pose
from .rig_estimate import rig_files, save_rig
from .saved_estimate import SavedEstimate
from .several_arms import own_jacobians


class RigFit(eqx.Module):
    """The joint fit of all cameras of a rig.

    Attributes:
        calibrations: calibration of each camera, by its name.
        covariance: covariance of the free parameters that all states have in common.
        parameter_names: names of these parameters (see `build_rig`).
        std: standard deviation of each free parameter, by name; of the states' corrections too.
        degrees_of_freedom: degrees of freedom of the common parameters' standard deviations.
        noises: standard deviations of pixels, reported poses and robot errors, by the arm's name;
            of a pair of arms, as `left+right`, the poses of one hand in the other's frame.
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
        arms: name of the arm of each camera, or of its pair of arms.
        warnings: reasons to doubt the result, a sentence each.
        small_sample_correction: what estimated noise adds to the covariance, and its degrees of
            freedom; None if the noise was given.
        sensors: depth sensor of each camera that has one, by the camera's name.
        picture_digests: digests of each camera's pictures, by its name, by which
            `smartview evaluate` recognises them.
        data: the data sets of the cameras.
        undetermined: combinations of parameters that neither the robots' motions nor anything else
            determines; they have the values of the start.
        contradicted_covariance: part of `covariance` for errors that held values cause, which the
            pictures contradict; None without such values.

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
    data: Rig
    warnings: tuple[str, ...] = eqx.field(static=True, default=())
    small_sample_correction: SmallSampleCorrection | None = None
    sensors: dict[str, DepthSensor] = eqx.field(static=True, default_factory=dict)
    picture_digests: dict[str, tuple[str, ...]] = eqx.field(static=True, default_factory=dict)
    undetermined: tuple[OpenDirections, ...] = ()
    contradicted_covariance: Float[np.ndarray, "free free"] | None = None

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
            if name in self.sensors:
                lines.append(f"  depth sensor: {self.sensors[name].described}")
        for arm, built in self.built_by_arm.items():
            robot, states = self.noises[arm], len(built.problem.per_view_free)
            lines.append(
                f"{arm if self.bases else 'robot'}: {1e3 * robot.translation:.3f} mm and "
                f"{np.degrees(robot.rotation):.4f} degrees of noise in {states} states"
            )
            estimate = self.noise_estimates.get(arm)
            if estimate is not None and estimate.directions is not None:
                worst = estimate.largest_noise
                lines.append(
                    f"  on average over their axes; {1e3 * worst.translation:.3f} mm and "
                    f"{np.degrees(worst.rotation):.4f} degrees in their worst direction"
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
        names, known, std = self.of_arm(self.arms[camera])
        names_in_rig, alone = built.camera_names[camera], parameter_names(built.starts[camera])
        local = dict(zip(names_in_rig, alone, strict=True))
        kept = [k for k, name in enumerate(names) if name in local]
        open_names = [local[names[k]] for k in kept if not np.isfinite(std[k])]
        # Nothing determines a parameter that was held because the robot's motion does not.
        held = (name for name in names_in_rig if name in self.std and name not in names)
        open_names += [local[name] for name in held if np.isinf(self.std[name])]
        directions = tuple(
            Direction(0.0, ((name, 1.0),), describe_direction(((name, 1.0),), calibration))
            for name in open_names
        )
        rank = sum(np.isfinite(std[k]) for k in kept)
        smallest = self.smallest_singular_value
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
            Observability(rank, rank + len(directions), directions, (), smallest),
            self.sensors.get(camera),
        )

    def of_arm(
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
        covariance = jacobian @ common @ jacobian.T
        is_open = any_changed(self.undetermined, self.parameter_names, jacobian)
        return (
            self.built.arms[arm].shared_names,
            covariance,
            np.where(is_open, np.inf, np.sqrt(np.diagonal(covariance))),
        )

    def on_one_mount(self, first: str, second: str) -> bool:
        """Return whether two cameras are on the hand of the same arm, or both next to it.

        Args:
            first: name of a camera.
            second: name of a camera.

        Raises:
            ValueError: there is no such camera.
        """
        mounts = [
            (self.calibrations[name].transform_names[0], arms_of(self.arms[name])[0])
            for name in map(self._checked, (first, second))
        ]
        return mounts[0] == mounts[1]

    def relative(self, first: str, second: str) -> RelativePose:
        """Return the pose of the second camera in the frame of the first, with its covariance.

        Args:
            first: name of a camera.
            second: name of a camera with the same mount.

        Raises:
            ValueError: no such camera, or cameras that a robot moves against each other.
        """
        a, b = (arms_of(self.arms[self._checked(name)])[0] for name in (first, second))
        if a != b:
            raise ValueError(
                f"relative: camera {first!r} is on arm {a!r} and {second!r} on {b!r}: their "
                "relative pose changes with the robots'; use `base` and their `camera_from_world`"
            )
        return relative_pose(self.calibrations, self._uncertainty, first, second)

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
        return relative_base(self.bases, self._uncertainty, first, second)

    @property
    def _uncertainty(self) -> RigUncertainty:
        """The uncertainty of the common parameters."""
        correction = self.small_sample_correction
        return RigUncertainty(self.parameter_names, self.covariance, correction, self.undetermined)

    def confidence_half_width(self, name: str, level: float = 0.95) -> float:
        """Return the half width of a parameter's confidence interval, in its own unit.

        Args:
            name: as in `parameter_names`.
            level: probability that the interval contains the true value.
        """
        return half_width(self.std[name], self.degrees_of_freedom[name], level)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write a page with the result, its accuracy, its warnings and plots (HTML)."""
        sv.report.write_rig_page(Path(path), self, self.data)

    def save(
        self,
        folder: str | os.PathLike[str],
        run: str | None = None,
    ) -> None:
        """Write a calibration file for each camera, `left.yaml`, and their joint covariance.

        Each camera's file has its own covariance and is read by `Calibration.load` and
        `load_estimate`; `rig.joint.yaml` has the joint covariance, for `load_rig_estimate`. Each of
        several arms has such a file of its own, `left.joint.yaml`, and the pose of every other base
        in the first one is written, such as base_left_from_base_right.yaml, which
        `RelativePose.load` reads. All are written, or none.

        Args:
            folder: of the files; created if it does not exist.
            run: name of the run that made them; None without one.
        """
        with file_transaction(folder, self.file_names) as place:
            for name in self.calibrations:
                self.estimate(name).save(
                    place / f"{name}.yaml",
                    run,
                    f"rig of {', '.join(self.calibrations)}",
                    self.warnings,
                    self.picture_digests.get(name, ()),
                )
            for name, base in self._named_bases():
                base.save(place / f"{name}.yaml", run)
            save_rig(self, place, run)

    @property
    def file_names(self) -> tuple[str, ...]:
        """The names of the files that `save` writes."""
        stems = (*self.calibrations, *(path for path, _ in self._named_bases()))
        return (*(f"{stem}.yaml" for stem in stems), *rig_files(self.noises).values())

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
