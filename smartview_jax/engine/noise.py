"""The assumed standard deviations of pixels and of the poses that the robot reports."""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from ..robot_errors import AbstractField
from .pose_directions import PoseDirections


@dataclasses.dataclass(frozen=True)
class Noise:
    """The standard deviations of pixels, of reported poses and of the robot error field.

    With a `Noise`, every view i has a correction `c_i` of its reported pose,
    `tool_from_base = exp(c_i) @ reported_i`, with a Gaussian prior of zero mean and these standard
    deviations.

    Attributes:
        pixel: effective standard deviation of u and of v, px.
        translation: standard deviation of the reported position, per axis at the tool, m; infinite
            if unknown.
        rotation: standard deviation of the reported orientation, per axis at the tool, rad;
            infinite if unknown.
        field: standard deviation of the coefficients of the robot error field, one for each of the
            field's groups.
        white_pixel: standard deviation of u and of v about the view's best pose, px; None if it
        equals `pixel`. Errors of real pixels are correlated within a view, so that a view has
        less information than its number of points suggests: `pixel` weights the points in the
        fit, and `white_pixel` predicts the scatter of single points.
        directions: the covariance of a reported pose's error, if it is larger in some directions
            than in others; `translation` and `rotation` are then roots of its mean variances over
            the axes. Predictions use it, whereas a fit with a given `Noise` uses the means.

    For example:

        >>> noise = sv.Noise(pixel=0.15, translation=1e-4, rotation=2e-4)
        >>> joint = sv.fit_joint(data, truth, noise=noise)
        >>> joint.pose_corrections.shape  # a twist for each view
        (8, 6)
    """

    pixel: float
    translation: float
    rotation: float
    field: tuple[float, ...] = ()
    white_pixel: float | None = None
    directions: PoseDirections | None = None

    def __post_init__(self) -> None:
        # Only the standard deviations of poses may be infinite (nothing known of the poses): an
        # infinite pixel sigma would give all observations zero weight.
        pose_sigmas = [("translation", self.translation), ("rotation", self.rotation)]
        finite_sigmas = [("pixel", self.pixel), *(("field", value) for value in self.field)]
        finite_sigmas += [] if self.white_pixel is None else [("white_pixel", self.white_pixel)]
        for name, value in pose_sigmas + finite_sigmas:
            if not (value > 0.0 and ((name, value) in pose_sigmas or value < math.inf)):
                raise ValueError(f"Noise.{name}: expected a positive number, found {value}")

    def with_unit_groups(self, field: AbstractField | None) -> "Noise":
        """Return the noise with a standard deviation of one for each group of a robot error field.

        Their values have no effect where the groups are held, or are set later.
        """
        count = 0 if field is None else len(field.groups)
        return dataclasses.replace(self, field=(1.0,) * count)

    @property
    def within_view_pixel(self) -> float:
        """Standard deviation of u and of v about the view's best pose, px."""
        # Without a separate model of whole-view errors, all pixel noise is within views.
        return self.pixel if self.white_pixel is None else self.white_pixel

    def pose_covariances(
        self, tool_from_base: Float[np.ndarray, "poses 3 3"]
    ) -> Float[np.ndarray, "poses 6 6"]:
        """Return the covariance of the error of reported poses, as twists at the tool (m, rad).

        Args:
            tool_from_base: rotation from the robot's base to its tool at each pose.
        """
        if self.directions is not None:
            return self.directions.covariances(tool_from_base)
        variances = np.repeat([self.translation**2, self.rotation**2], 3)
        return np.tile(np.diag(variances), (len(tool_from_base), 1, 1))

    @property
    def has_pose_prior(self) -> bool:
        """Whether reported poses have a finite standard deviation, of translation or rotation.

        If not, only the residuals determine the pixel sigma.
        """
        return min(self.translation, self.rotation) < math.inf
