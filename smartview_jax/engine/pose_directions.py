"""Describe robots whose reported poses err more in some directions than in others."""

import dataclasses
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

Rows: TypeAlias = tuple[tuple[float, ...], ...]
"""The rows of a matrix, as a value that can be hashed."""


@dataclasses.dataclass(frozen=True)
class PoseDirections:
    """The covariance of a reported pose's error, which follows the axes of the tool and the base.

    A pose's error is a twist at the tool, translation (m) first, whose covariance is

        in_tool + R in_base R^T

    with R the rotation from the base to the tool, which turns translation and rotation alike.

    Attributes:
        in_tool: covariance of the part that follows the tool's axes, 6 rows of 6 numbers.
        in_base: covariance of the part that follows the base's axes.
    """

    in_tool: Rows
    in_base: Rows

    def __post_init__(self) -> None:
        for name in ("in_tool", "in_base"):
            rows = np.array(getattr(self, name), dtype=float)
            if rows.shape != (6, 6) or not np.isfinite(rows).all():
                raise ValueError(f"PoseDirections.{name}: expected 6 rows of 6 finite numbers")
            # Their sum is a covariance at every pose only if each is one.
            values = np.linalg.eigvalsh(0.5 * (rows + rows.T))
            tolerance = 1e-9 * np.abs(values).max()
            if np.abs(rows - rows.T).max() > tolerance or values[0] < -tolerance:
                raise ValueError(f"PoseDirections.{name}: expected a covariance")

    @classmethod
    def of(
        cls, in_tool: Float[np.ndarray, "6 6"], in_base: Float[np.ndarray, "6 6"]
    ) -> "PoseDirections":
        """Return the directions with these covariances."""
        tool, base = (tuple(tuple(map(float, row)) for row in part) for part in (in_tool, in_base))
        return cls(tool, base)

    def covariances(
        self, tool_from_base: Float[np.ndarray, "poses 3 3"]
    ) -> Float[np.ndarray, "poses 6 6"]:
        """Return the covariance of the error of each pose, from its rotation."""
        turned = twist_rotations(tool_from_base)
        return np.array(self.in_tool) + turned @ np.array(self.in_base) @ turned.swapaxes(1, 2)


def twist_rotations(rotations: Float[np.ndarray, "poses 3 3"]) -> Float[np.ndarray, "poses 6 6"]:
    """Return the matrices that turn the translation and the rotation of twists alike."""
    result = np.zeros((len(rotations), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = rotations
    return result
