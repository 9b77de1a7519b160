"""Observability of the parameters: rank and null directions of the scaled Jacobian."""

from typing import NamedTuple

import numpy as np

from ..calibration import Calibration
from ..geometry import host_matrices
from .covariance import RANK_TOLERANCE, ScaledJacobian

WEAK_SINGULAR_VALUE = 1e-3
"""Singular value, of the Jacobian with unit columns, below which a direction is called weak."""


class Direction(NamedTuple):
    """A combination of parameters that the data determine poorly or not at all.

    Attributes:
        singular_value: singular value of the Jacobian with unit columns; 1 is the best possible.
        components: change of each parameter along the direction, in the parameter's own unit,
            largest effect first.
        description: the same as a sentence.
    """

    singular_value: float
    components: tuple[tuple[str, float], ...]
    description: str


class Observability(NamedTuple):
    """The rank of a fit's Jacobian, and the directions that the data determine poorly or not.

    Attributes:
        rank: rank of the scaled Jacobian.
        parameter_count: number of free parameters.
        null_directions: unobservable directions.
        weak_directions: poorly observable directions.
        smallest_singular_value: the smallest singular value.
    """

    rank: int
    parameter_count: int
    null_directions: tuple[Direction, ...]
    weak_directions: tuple[Direction, ...]
    smallest_singular_value: float


def observability(
    jacobian: ScaledJacobian, names: tuple[str, ...], calibration: Calibration
) -> Observability:
    """Compute the rank, the null directions and the weak directions of a fit.

    Args:
        jacobian: decomposition of the Jacobian at the optimum.
        names: names of the free parameters.
        calibration: the calibration at which the Jacobian was taken.
    """
    singular_values, Vt = jacobian.singular_values, jacobian.right_singular_vectors
    # With D the column norms, the decomposed Jacobian is J D^-1: a direction v of it is D^-1 v in
    # the parameters' own units.
    inverse_norms = 1.0 / jacobian.column_norms

    def direction(k: int) -> Direction:
        """Return the k-th right singular vector as a `Direction`."""
        order = np.argsort(-np.abs(Vt[k]))
        # At most eight components, above 5 % of the largest, for readability.
        largest = [i for i in order if abs(Vt[k, i]) > 0.05 * abs(Vt[k, order[0]])][:8]
        components = tuple((names[i], float(Vt[k, i] * inverse_norms[i])) for i in largest)
        is_null = bool(singular_values[k] <= RANK_TOLERANCE)
        text = describe_direction(components, calibration, is_null)
        return Direction(float(singular_values[k]), components, text)

    return Observability(
        int(np.sum(singular_values > RANK_TOLERANCE)),
        len(names),
        tuple(direction(int(k)) for k in np.flatnonzero(singular_values <= RANK_TOLERANCE)),
        tuple(
            direction(int(k))
            for k in np.flatnonzero(
                (singular_values > RANK_TOLERANCE) & (singular_values <= WEAK_SINGULAR_VALUE)
            )
        ),
        float(singular_values[-1]) if len(singular_values) else 1.0,
    )


def describe_direction(
    components: tuple[tuple[str, float], ...], calibration: Calibration, is_null: bool = True
) -> str:
    """Describe a direction as a sentence.

    A shift of the camera on its mount, alone or together with a shift of the target, is described
    in the frame of the mount; every other direction as a list of parameters, scaled to 1 mm, 1
    degree or one unit of the first.

    Args:
        components: the direction, as in `Direction`.
        calibration: the calibration whose parameters these are.
        is_null: whether the data do not determine the direction at all.
    """
    camera_transform, world_transform = calibration.transform_names
    blocks = {".".join(name.split(".")[:2]) for name, _ in components}
    camera_translation = f"{camera_transform}.translation"
    if camera_translation in blocks and blocks <= {
        camera_translation,
        f"{world_transform}.translation",
    }:
        mount = camera_transform.removeprefix("camera_from_")
        displacement = np.zeros(3)
        for name, value in components:
            if name.startswith(camera_translation):
                displacement["xyz".index(name[-1])] = value
        # t = translation of camera_from_mount is in camera axes; R^T t is in the axes of the mount.
        rotation = host_matrices(calibration.camera_from_mount)[:3, :3]
        axis = _describe_axis(rotation.T @ displacement)
        # A direction that noise hides has no such cause.
        cause = ": all rotations share that axis" if is_null else ""
        return f"camera offset along the {mount}'s {axis}{cause}"
    scaled = [
        (name, value * factor, unit)
        for name, value in components
        for factor, unit in [_display_unit(name)]
    ]
    first = abs(scaled[0][1]) or 1.0
    listed = ", ".join(f"{name} ({value / first:+.2g}{unit})" for name, value, unit in scaled)
    return f"a combination of parameters: {listed}"


def _display_unit(name: str) -> tuple[float, str]:
    """Return the factor from a parameter's own unit to the one that people read, and its name."""
    if ".translation." in name:
        return 1e3, " mm"
    if ".rotation." in name:
        return float(np.rad2deg(1.0)), " degrees"
    return 1.0, ""


def _describe_axis(vector: np.ndarray) -> str:
    """Return a vector's axis as a letter if within ten degrees of it, otherwise as numbers."""
    unit = vector / max(float(np.linalg.norm(vector)), 1e-300)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > np.cos(np.deg2rad(10.0)):
        return f"{'xyz'[k]} axis"
    return f"direction ({unit[0]:+.2f}, {unit[1]:+.2f}, {unit[2]:+.2f})"
