"""The result of estimating the noise model, with the models of the robot error that were tried."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from ..calibration import SHAPE_NAMES, Calibration, TargetShape
from ..engine import TARGET_SCALE, Noise, Prior
from ..robot_errors import AbstractField, RobotPrior
from .directional_noise import DirectionalNoise, largest_noise
from .kenward_roger import SmallSampleCorrection
from .lens_terms import LensEvidence
from .model_selection import ModelName
from .robot_evidence import RobotEvidence


class CandidateResult(NamedTuple):
    """A model of the robot error that was tried.

    Attributes:
        model: its robot error field by name, and whether the target's scale was free as well.
        probability: posterior probability of the model; zero if another field was requested.
        log_likelihood_ratio: twice the logarithm of its penalised likelihood relative to white
            noise of the poses alone.
        noise: the standard deviations that maximise its posterior.
    """

    model: ModelName
    probability: float
    log_likelihood_ratio: float
    noise: Noise

    @property
    def name(self) -> str:
        """The name of the model, for printing."""
        return str(self.model)


class TargetScaleEvidence(NamedTuple):
    """The evidence of the views on the size of the target.

    Attributes:
        probability: probability that the size is not as stated.
        scale: size of the target over its stated size, if it is not as stated.
        std: standard deviation of `scale`.
    """

    probability: float
    scale: float
    std: float


MIN_SHAPE_SIGMAS = 3.0
"""The smallest bow or stretch of the target that is named, in standard deviations."""


class TargetShapeEstimate(NamedTuple):
    """The estimated shape of the target.

    Attributes:
        shape: the shape.
        covariance: covariance of its coefficients, m^2.
        by_shape: derivative of each of the fit's shared parameters, and then of the coefficients
            themselves, by each coefficient.
    """

    shape: TargetShape
    covariance: Float[np.ndarray, "5 5"]
    by_shape: Float[np.ndarray, "shared 5"]

    def bow(self, points: Float[np.ndarray, "points 3"]) -> tuple[float, float]:
        """Return the height of the highest above the lowest point, and its standard deviation, m.

        Args:
            points: the target's points as stated, m.
        """
        shape = jax.tree.map(np.asarray, self.shape)
        along_z = np.asarray(shape.directions(points))[..., 2]
        heights = along_z @ shape.coefficients
        difference = along_z[np.argmax(heights)] - along_z[np.argmin(heights)]
        std = np.sqrt(difference @ self.covariance @ difference)
        return float(np.ptp(heights)), float(std)

    @property
    def stretch(self) -> tuple[float, float]:
        """By which part the target is longer along x than along y, and its standard deviation."""
        k = SHAPE_NAMES.index("aspect")
        # x is stretched by this part of the half size, and y shortened.
        by_aspect = 2.0 / float(self.shape.half_size)
        coefficient = float(np.asarray(self.shape.coefficients)[k])
        return by_aspect * coefficient, by_aspect * float(np.sqrt(self.covariance[k, k]))

    @property
    def is_stretched(self) -> bool:
        """Whether the target is certainly longer along one axis than stated."""
        stretch, std = self.stretch
        return abs(stretch) > MIN_SHAPE_SIGMAS * std


class NoiseEstimate(NamedTuple):
    """A noise model, averaged over models of the robot error by their probabilities.

    Attributes:
        name: name of the most probable model.
        noise: standard deviations of all errors in the averaged model.
        field: robot error field; None if the views need none.
        encompassing_field: field that contains the fields of all models; the fit uses it, holding
            the groups that are not in `field` at zero.
        calibration: the calibration at the end of the estimation.
        candidates: all models of the robot error that were tried.
        target_scale: evidence on the target's size; None if it was not estimated.
        target_scale_std: prior standard deviation of the logarithm of the target's size in the
            averaged model, about the stated size; None if the size is held.
        target_shape: the target's shape; None if the target is not flat, or held as stated.
        mount_displacement: displacement of the camera's mount by the robot error field, relative to
            white noise alone: translation (m) and rotation (rad); None without a field, or if the
            mount is held.
        converged: whether the standard deviations converged.
        relative_std: relative standard errors of the estimated standard deviations of pixel,
        translation, rotation and field; large for undetermined ones near zero.
        parameter_names: names of the fit's shared parameters, then of the target's shape.
        small_sample_correction: contribution of the uncertain standard deviations to the
            covariance of the shared parameters.
        between_models_covariance: covariance of the shared parameters between the models, about
            the fit of the averaged model.
        robot_prior: prior of the robot's errors.
        noise_corrections: twists at the tool that correct the reported poses for noise; the robot
            error field is evaluated at the corrected poses. None evaluates it at the reported ones.
        lens: evidence for distortion that the lens model does not describe.
        robot_evidence: what the views say about the sizes of the robot's errors.
        directions: the directions in which the robot's poses err most; None if they err alike in
            all. The standard deviations of poses in `noise` are then means over the axes.
        alike: the estimate for errors that are alike in all directions; None if this is it.
    """

    name: str
    noise: Noise
    field: AbstractField | None
    encompassing_field: AbstractField | None
    calibration: Calibration
    candidates: tuple[CandidateResult, ...]
    target_scale: TargetScaleEvidence | None
    target_scale_std: float | None
    target_shape: TargetShapeEstimate | None
    mount_displacement: tuple[float, ...] | None
    converged: bool
    relative_std: tuple[float, ...]
    parameter_names: tuple[str, ...]
    small_sample_correction: SmallSampleCorrection
    between_models_covariance: Float[np.ndarray, "shared shared"]
    robot_prior: RobotPrior
    noise_corrections: Float[np.ndarray, "views 6"] | None = None
    lens: LensEvidence | None = None
    robot_evidence: RobotEvidence | None = None
    directions: DirectionalNoise | None = None
    alike: "NoiseEstimate | None" = None

    @property
    def largest_pose_sigmas(self) -> tuple[float, float]:
        """The standard deviations of reported translations, m, and rotations, rad.

        They are for the directions in which these err most.
        """
        noise = largest_noise(self.noise, self.directions)
        return float(noise.translation), float(noise.rotation)

    @property
    def free(self) -> tuple[str, ...]:
        """The paths of the parameters that the estimation made free."""
        return () if self.target_scale_std is None else (TARGET_SCALE,)

    def priors(self, start: Calibration) -> dict[str, Prior]:
        """Return the priors of these parameters, about their values in the start."""
        if self.target_scale_std is None:
            return {}
        return {TARGET_SCALE: Prior(std=self.target_scale_std * float(start.target_scale))}

    def by_names(
        self,
        named_by_fitted: Float[np.ndarray, "fitted fitted"],
        covariance: Float[np.ndarray, "shared shared"],
    ) -> "NoiseEstimate":
        """Return the estimate with all covariances by the parameters as they are named.

        Args:
            named_by_fitted: as `AbstractProblem.host_named_by_fitted` returns it.
            covariance: covariance of the fitted parameters and then of the target's shape.
        """
        shape_count = len(covariance) - len(named_by_fitted)
        by_fitted = np.asarray(block_diag(named_by_fitted, np.eye(shape_count)))

        def converted(matrix: Float[np.ndarray, "shared shared"]) -> np.ndarray:
            """Return a covariance by the parameters as they are named."""
            return by_fitted @ matrix @ by_fitted.T

        lens, shape = self.lens, self.target_shape
        return self._replace(
            small_sample_correction=self.small_sample_correction.by_names(by_fitted, covariance),
            between_models_covariance=converted(self.between_models_covariance),
            lens=None if lens is None else lens._replace(covariance=converted(lens.covariance)),
            target_shape=None
            if shape is None
            else shape._replace(by_shape=by_fitted @ shape.by_shape),
        )

    def correction_of(self, names: Sequence[str]) -> SmallSampleCorrection:
        """Return the small-sample correction for a subset of the parameters."""
        return self.small_sample_correction.subset(self._indices(names))

    def covariance_of_choices(self, names: Sequence[str]) -> Float[np.ndarray, "subset subset"]:
        """Return the covariance of some parameters that a fit of the averaged model lacks.

        It is due to the disagreement between the models, to possible distortion that the lens model
        does not describe, and to the target's uncertain shape.
        """
        indices = self._indices(names)
        covariance = self.between_models_covariance[np.ix_(indices, indices)]
        if self.lens is not None:
            covariance = covariance + self.lens.covariance[np.ix_(indices, indices)]
        if self.target_shape is None:
            return covariance
        by_shape = self.target_shape.by_shape[indices]
        return covariance + by_shape @ self.target_shape.covariance @ by_shape.T

    def _indices(self, names: Sequence[str]) -> np.ndarray:
        """Return the indices of parameters."""
        return np.array([self.parameter_names.index(n) for n in names], dtype=int)
