"""The standard deviations of all errors of a calibration, whose squares are variance components."""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from ..engine import Step
from ..runtime.array_namespace import AnyArray, array_namespace

ROBOT_SIGMA_FLOOR = 1e-8
"""Standard deviation, m or rad, at which an error of the robot counts as zero.

It is not smaller, so that its inverse square, times the square of a pose error of centimetres, does
not swamp the significant digits of the deviance.
"""

IS_POSE_KIND = np.repeat(np.eye(2), 3, axis=1)
"""One where a view's own parameter belongs to the translation (row 0) or the rotation (row 1)."""

AnyScalars: TypeAlias = Float[AnyArray, "*searches"] | float
"""A number, or one for each of several searches."""


class StandardDeviations(NamedTuple):
    """The standard deviations of all errors, all positive.

    Their squares are the variance components. Of several searches they are arrays whose first axis
    counts the searches.

    Attributes:
        pixel: effective pixel sigma, px.
        translation: standard deviation of the translation of reported poses, m.
        rotation: standard deviation of the rotation of reported poses, rad.
        field: standard deviation of the coefficients in each group of the robot error field;
            `ROBOT_SIGMA_FLOOR` disables a group.
    """

    pixel: AnyScalars
    translation: AnyScalars
    rotation: AnyScalars
    field: Float[AnyArray, "*searches groups"]

    @property
    def vector(self) -> Float[AnyArray, "*searches kinds"]:
        """The standard deviations as a vector: pixel, translation, rotation, field."""
        xp = array_namespace(*self)
        pixel_and_pose = xp.array([self.pixel, self.translation, self.rotation])
        return xp.concatenate([pixel_and_pose.T, self.field], axis=-1)

    @classmethod
    def from_vector(cls, vector: Float[AnyArray, "*searches kinds"]) -> "StandardDeviations":
        """Create the standard deviations from a vector in the order of `vector`."""
        pixel, translation, rotation = vector.T[:3]
        return cls(pixel, translation, rotation, vector[..., 3:])

    def prior_weights(
        self,
        group_index: Int[AnyArray, "*searches shared"],
        known_weight: Float[AnyArray, "*searches shared"],
    ) -> Step:
        """Return one over the prior standard deviation of every parameter.

        The views' own have one common row.

        Args:
            group_index: group of each shared parameter, as in `LinearisedViews`.
            known_weight: weights of the parameters that belong to no group.
        """
        xp = array_namespace(*self)
        # Index -1 (no group) reads the last one, which `where` then discards.
        field = xp.concatenate([self.field, xp.ones((*self.field.shape[:-1], 1))], axis=-1)
        field = (
            field[..., group_index]
            if group_index.ndim == 1
            else xp.take_along_axis(field, group_index, -1)
        )
        translation, rotation = (xp.asarray(x)[..., None] for x in self[1:3])
        pose_sigmas = translation * IS_POSE_KIND[0] + rotation * IS_POSE_KIND[1]
        weights = xp.where(group_index >= 0, 1.0 / field, known_weight)
        return Step(weights, 1.0 / pose_sigmas[..., None, :])
