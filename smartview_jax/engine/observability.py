"""Observability of the parameters: rank and null directions of the scaled Jacobian."""

from typing import NamedTuple

import numpy as np

from ..calibration import Calibration
from .covariance import NULL, UnitColumns

WEAK = 1e-3
"""Singular value, of the Jacobian with unit columns, below which a direction is called weak."""


class Direction(NamedTuple):
    """A combination of parameters that the data determine poorly or not at all.

    Attributes:
        singular_value: singular value of the Jacobian with unit columns; 1 is the best possible.
        components: change of each parameter along the direction, in the parameter's own unit,
            largest effect first.
        words: the same as a sentence.
    """

    singular_value: float
    components: tuple[tuple[str, float], ...]
    words: str


class Observability(NamedTuple):
    """The number of directions in parameter space that the data determine, and the others.

    Attributes:
        rank: rank of the scaled Jacobian.
        size: number of free parameters.
        null: unobservable directions.
        weak: poorly observable directions.
        smallest: the smallest singular value.
    """

    rank: int
    size: int
    null: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    smallest: float


def observability(
    columns: UnitColumns, names: tuple[str, ...], calibration: Calibration
) -> Observability:
    """Compute the rank, the null directions and the weak directions of a fit.

    Args:
        columns: singular values and directions of the Jacobian at the optimum.
        names: names of the free parameters.
        calibration: the calibration at which the Jacobian was taken.
    """
    singular, Vt = columns.singular, columns.directions
    # With D the lengths of the columns, the decomposed Jacobian is J D^-1: a direction v of it is
    # D^-1 v in the parameters' own units.
    own = 1.0 / columns.lengths

    def direction(k: int) -> Direction:
        """Return the k-th right singular vector as a `Direction`."""
        order = np.argsort(-np.abs(Vt[k]))
        # At most eight components, and none below 5 % of the largest: more are unreadable.
        strong = [i for i in order if abs(Vt[k, i]) > 0.05 * abs(Vt[k, order[0]])][:8]
        parts = tuple((names[i], float(Vt[k, i] * own[i])) for i in strong)
        return Direction(float(singular[k]), parts, _words(parts, calibration))

    return Observability(
        int(np.sum(singular > NULL)),
        len(names),
        tuple(direction(int(k)) for k in np.flatnonzero(singular <= NULL)),
        tuple(direction(int(k)) for k in np.flatnonzero((singular > NULL) & (singular <= WEAK))),
        float(singular[-1]) if len(singular) else 1.0,
    )


def _words(parts: tuple[tuple[str, float], ...], calibration: Calibration) -> str:
    """Describe a direction as a sentence.

    A shift of the camera on its mount, alone or together with a shift of the target, is described
    in the frame of the mount; every other direction as a list of parameters.
    """
    camera_transform, world_transform = calibration.transform_names
    blocks = {".".join(name.split(".")[:2]) for name, _ in parts}
    moved = f"{camera_transform}.translation"
    if moved in blocks and blocks <= {moved, f"{world_transform}.translation"}:
        mount = camera_transform.removeprefix("camera_from_")
        step = np.zeros(3)
        for name, value in parts:
            if name.startswith(moved):
                step["xyz".index(name[-1])] = value
        # t = translation of camera_from_mount is in camera axes; R^T t is in the axes of the mount.
        rotation = np.asarray(calibration.camera_from_mount.rotation().as_matrix())
        axis = _axis(rotation.T @ step)
        return f"camera offset along the {mount}'s {axis}: all rotations share that axis"
    listed = ", ".join(f"{name} ({value:+.2g})" for name, value in parts)
    return f"only together, not one by one: {listed}"


def _axis(vector: np.ndarray) -> str:
    """Return a vector's axis as a letter if within ten degrees of it, otherwise as numbers."""
    unit = vector / max(float(np.linalg.norm(vector)), 1e-300)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > np.cos(np.deg2rad(10.0)):
        return f"{'xyz'[k]} axis"
    return f"direction ({unit[0]:+.2f}, {unit[1]:+.2f}, {unit[2]:+.2f})"
