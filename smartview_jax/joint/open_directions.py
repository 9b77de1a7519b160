"""Tell which numbers that follow from a fit's parameters nothing determines."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..engine import RANK_TOLERANCE, ScaledJacobian
from .undetermined_motion import NEGLIGIBLE_PART, UndeterminedMotion

ROUNDING = 1e-6
"""Part of a unit direction, relative to the number's sensitivity, that is rounding."""


class OpenDirections(eqx.Module):
    """Combinations of parameters that nothing determines, which a fit keeps where it started.

    Attributes:
        names: names of the parameters.
        directions: combinations of the parameters, each in its unit of `units`.
        units: unit of each parameter, in its own unit.
        tolerance: part of a direction, of its largest component, below which it is neglected.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    directions: Float[np.ndarray, "directions parameters"]
    units: Float[np.ndarray, "parameters"]
    tolerance: float = eqx.field(static=True)

    @classmethod
    def of_motion(cls, motion: UndeterminedMotion) -> "OpenDirections":
        """Return the directions that the robot's motion leaves open."""
        # Metres and radians.
        return cls(motion.names, motion.directions, np.ones(len(motion.names)), NEGLIGIBLE_PART)

    @classmethod
    def of_jacobian(cls, names: tuple[str, ...], jacobian: ScaledJacobian) -> "OpenDirections":
        """Return the directions that change no residual, among the free parameters."""
        is_open = jacobian.singular_values <= RANK_TOLERANCE
        vectors = jacobian.right_singular_vectors[is_open]
        return cls(names, vectors, 1.0 / jacobian.column_norms, ROUNDING)

    def changed(
        self, names: Sequence[str], jacobian: Float[np.ndarray, "numbers given"]
    ) -> Bool[np.ndarray, "numbers"]:
        """Return which numbers change along one of the directions, and so are undetermined.

        Args:
            names: names of parameters.
            jacobian: derivative of the numbers by these parameters, each in its own unit.
        """
        place = {name: k for k, name in enumerate(names)}
        rows = [place.get(name, -1) for name in self.names]
        # A parameter that is not named has no effect.
        sensitivity = np.pad(jacobian, ((0, 0), (0, 1)))[:, rows] * self.units
        largest = np.abs(self.directions).max(axis=1, initial=0.0)
        limits = self.tolerance * np.outer(np.linalg.norm(sensitivity, axis=1), largest)
        return np.asarray((np.abs(sensitivity @ self.directions.T) > limits).any(axis=1))


def any_changed(
    undetermined: Sequence[OpenDirections],
    names: Sequence[str],
    jacobian: Float[np.ndarray, "numbers given"],
) -> Bool[np.ndarray, "numbers"]:
    """Return which numbers some undetermined direction changes; arguments as of `changed`."""
    changed = [directions.changed(names, jacobian) for directions in undetermined]
    return np.any([np.zeros(len(jacobian), dtype=bool), *changed], axis=0)
