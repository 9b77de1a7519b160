"""The directions in which the poses that a robot reports err most.

`directional_search` finds them.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..engine import Noise, PoseDirections, twist_rotations
from .standard_deviations import StandardDeviations

Matrices = Float[np.ndarray, "views 6 6"]
"""A matrix for the pose of each view, by twists at the tool with the translation first."""


class DirectionalNoise(NamedTuple):
    """The covariance of the errors of poses, averaged over hypotheses on their directions.

    Attributes:
        translation: root of the mean variance of translations over axes and views, m.
        rotation: the same of rotations, rad, whatever the translations are.
        roots: twist at the tool by six independent parameters of a view, three with the standard
            deviation `translation` and three with `rotation`.
        probabilities: probabilities of the hypotheses, by name.
        covariances: covariance of the errors of poses of each hypothesis.
        slopes: derivative of the averaged covariance by all uncertain entries.
        uncertainty: covariance of these entries.
    """

    translation: float
    rotation: float
    roots: Matrices
    probabilities: dict[str, float]
    covariances: dict[str, Matrices]
    slopes: Float[np.ndarray, "directions views 6 6"]
    uncertainty: Float[np.ndarray, "directions directions"]

    @property
    def covariance(self) -> Matrices:
        """The covariance of the error of every view's pose, translation (m) first."""
        variances = np.repeat([self.translation**2, self.rotation**2], 3)
        return (self.roots * variances) @ self.roots.swapaxes(1, 2)

    @property
    def worst(self) -> Float[np.ndarray, "2"]:
        """The standard deviations of translation, m, and rotation, rad, in their worst directions.

        Their variances are means over the views.
        """
        covariance = self.covariance
        blocks = np.stack([covariance[:, :3, :3], covariance[:, 3:, 3:]])
        return np.sqrt(np.linalg.eigvalsh(blocks)[..., -1].mean(axis=1))

    def at_any_pose(self, tool_from_base: Float[np.ndarray, "views 3 3"]) -> PoseDirections:
        """Return the directions without the views in which they were estimated.

        Args:
            tool_from_base: rotation from the robot's base to its tool in these views.
        """
        in_tool, in_base = np.zeros((2, 6, 6))
        turned = twist_rotations(tool_from_base.swapaxes(1, 2))
        for name, probability in self.probabilities.items():
            covariance = self.covariances[name]
            if name.startswith("base "):
                of_base = turned @ covariance @ turned.swapaxes(1, 2)
                in_base += probability * of_base.mean(axis=0)
            else:
                in_tool += probability * covariance.mean(axis=0)
        # Rounding in the mean of products.
        return PoseDirections.of(*(0.5 * (part + part.T) for part in (in_tool, in_base)))

    def with_sizes(self, sizes: Float[np.ndarray, "2"]) -> "DirectionalNoise":
        """Return the noise whose independent parameters have other standard deviations.

        The hypotheses grow with their average. `translation` and `rotation` of the result are
        again the roots of the mean variances, and differ from the given standard deviations where
        rotations are correlated with translations; its `roots` make up for the difference.

        Args:
            sizes: standard deviations of the first and the last three parameters of the present
                `roots`, m and rad.
        """
        covariance = (self.roots * np.repeat(sizes**2, 3)) @ self.roots.swapaxes(1, 2)
        translation, rotation = mean_sizes(covariance)
        factors = np.repeat(sizes / [translation, rotation], 3)
        # Twists with the new sizes, by twists with the present ones.
        growth = np.repeat(sizes / [self.translation, self.rotation], 3)
        grown = (self.roots * growth) @ np.linalg.inv(self.roots)
        transposed = grown.swapaxes(1, 2)
        return self._replace(
            translation=float(translation),
            rotation=float(rotation),
            roots=self.roots * factors,
            covariances={
                name: grown @ each @ transposed for name, each in self.covariances.items()
            },
            slopes=grown[None] @ self.slopes @ transposed[None],
        )


def largest_noise(noise: Noise, directions: DirectionalNoise | None) -> Noise:
    """Return a noise with the sizes of the poses' errors in the directions in which they are most.

    Args:
        noise: with mean sizes over the axes.
        directions: of the errors; None if they are alike in all.
    """
    if directions is None:
        return noise
    translation, rotation = map(float, directions.worst)
    return dataclasses.replace(noise, translation=translation, rotation=rotation, directions=None)


def effect_of_directions(
    noise: DirectionalNoise, sigmas: StandardDeviations
) -> Float[np.ndarray, "directions views 6 6"]:
    """Return the change of the views' prior precision in own axes by each uncertain entry."""
    inverse = np.linalg.inv(noise.roots)
    precision = np.repeat(pose_sigmas(sigmas) ** -2, 3)
    changes = inverse[None] @ noise.slopes @ inverse.swapaxes(1, 2)[None]
    return -precision[:, None] * changes * precision


def mean_sizes(covariance: Matrices) -> Float[np.ndarray, "2"]:
    """Return the roots of the mean variances of translation and rotation over axes and views."""
    variances = np.diagonal(covariance, axis1=1, axis2=2).mean(axis=0)
    return np.sqrt(variances.reshape(2, 3).mean(axis=1))


def pose_sigmas(sigmas: StandardDeviations) -> Float[np.ndarray, "2"]:
    """Return the standard deviations of translation and rotation."""
    return np.array([float(sigmas.translation), float(sigmas.rotation)])
