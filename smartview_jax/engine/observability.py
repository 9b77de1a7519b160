"""What the data cannot tell: rank and null directions of the scaled Jacobian, in words."""

from typing import NamedTuple

import numpy as np

from ..calibration import Calibration
from .covariance import NULL, UnitColumns

WEAK = 1e-3
"""Singular value, of a Jacobian with unit columns, under which a direction is reported as weak."""


class Direction(NamedTuple):
    """A combination of parameters that the data see badly or not at all.

    Attributes:
        singular_value: of the Jacobian with unit columns; 1 is as good as it gets.
        components: how far each parameter moves along it (own units), largest effect first.
        words: the same as a sentence.
    """

    singular_value: float
    components: tuple[tuple[str, float], ...]
    words: str


class Observability(NamedTuple):
    """How many directions of the free parameters the data determine.

    Attributes:
        rank: of the scaled Jacobian.
        size: number of free parameters.
        null: the directions not seen.
        weak: those seen badly.
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
    """Rank and null directions of a fit.

    Args:
        columns: of the Jacobian at the optimum.
        names: of the free parameters.
        calibration: where the Jacobian was taken.
    """
    singular, Vt = columns.singular, columns.directions
    own = 1.0 / columns.lengths

    def direction(k: int) -> Direction:
        order = np.argsort(-np.abs(Vt[k]))
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
    camera_transform, world_transform = calibration.transform_names
    blocks = {".".join(name.split(".")[:2]) for name, _ in parts}
    moved = f"{camera_transform}.translation"
    if moved in blocks and blocks <= {moved, f"{world_transform}.translation"}:
        mount = camera_transform.removeprefix("camera_from_")
        step = np.zeros(3)
        for name, value in parts:
            if name.startswith(moved):
                step["xyz".index(name[-1])] = value
        rotation = np.asarray(calibration.camera_from_mount.rotation().as_matrix())
        axis = _axis(rotation.T @ step)
        return f"camera offset along the {mount}'s {axis}: all rotations share that axis"
    listed = ", ".join(f"{name} ({value:+.2g})" for name, value in parts)
    return f"only together, not one by one: {listed}"


def _axis(vector: np.ndarray) -> str:
    """An axis by its letter where it is within ten degrees, otherwise as numbers."""
    unit = vector / max(float(np.linalg.norm(vector)), 1e-300)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > np.cos(np.deg2rad(10.0)):
        return f"{'xyz'[k]} axis"
    return f"direction ({unit[0]:+.2f}, {unit[1]:+.2f}, {unit[2]:+.2f})"
