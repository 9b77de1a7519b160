"""Solve the linear equations of features that share constraints and unknowns.

Each feature (a point or a line) has its own small normal matrix; unknowns common to many features
(numbers of the calibration, planes of constraints, points that too few views see) are the *border*.
With exact constraints (S = 0) and soft ones (S their covariance) alike, a step solves

    [ H    B    A^T ] [ dx ]     [ g  ]
    [ B^T  P    C^T ] [ db ] = - [ gb ]
    [ A    C    -S  ] [ m  ]     [ c  ]

H is block-diagonal and eliminated first; the remaining system has one row for each border unknown
and constraint, whatever the number of features. The multipliers m are the forces of the
constraints.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

EXACT_VARIANCE = 1e-8
"""Variance of an exact constraint, over the variance that the pictures leave its numbers.

With zero, redundant constraints would make the equations singular; with this value an exact
constraint holds to a ten-thousandth of the pictures' standard deviation."""


class FeatureBlocks(NamedTuple):
    """Block-diagonal matrices of points (3x3) and lines (4x4), points first."""

    points: Float[np.ndarray, "points 3 3"]
    lines: Float[np.ndarray, "lines 4 4"]

    @property
    def size(self) -> int:
        """Number of rows."""
        return 3 * len(self.points) + 4 * len(self.lines)

    def inverse(self) -> "FeatureBlocks":
        """Return the inverse of every block."""
        return FeatureBlocks(_scaled_inverse(self.points), _scaled_inverse(self.lines))

    def damped(self, damping: float) -> "FeatureBlocks":
        """Return the blocks with their diagonals multiplied by one plus the damping."""
        return FeatureBlocks(
            self.points * (1.0 + damping * np.eye(3)), self.lines * (1.0 + damping * np.eye(4))
        )

    def times(
        self, right: Float[np.ndarray, "rows *columns"]
    ) -> Float[np.ndarray, "rows *columns"]:
        """Return the product with a vector or a matrix."""
        split = 3 * len(self.points)
        parts = []
        for blocks, part in ((self.points, right[:split]), (self.lines, right[split:])):
            by_block = part.reshape(*blocks.shape[:2], *right.shape[1:])
            parts.append(np.einsum("kij,kj...->ki...", blocks, by_block).reshape(part.shape))
        return np.concatenate(parts)


def _scaled_inverse(
    blocks: Float[np.ndarray, "blocks n n"],
) -> Float[np.ndarray, "blocks n n"]:
    """Return the inverses of symmetric blocks, scaled to a unit diagonal for precision."""
    # A line has metres and radians in one block; scaling leaves only correlations in its condition.
    scale = np.sqrt(np.einsum("kii->ki", blocks))
    outer = scale[:, :, None] * scale[:, None]
    return np.linalg.inv(blocks / outer) / outer


class ConstrainedSystem(NamedTuple):
    """The matrix of the module's docstring.

    Attributes:
        features: H.
        feature_border: B.
        border: P.
        feature_constraints: A.
        border_constraints: C.
        constraint_variance: S, the diagonal; zero for exact constraints.
    """

    features: FeatureBlocks
    feature_border: Float[np.ndarray, "rows border"]
    border: Float[np.ndarray, "border border"]
    feature_constraints: Float[np.ndarray, "constraints rows"]
    border_constraints: Float[np.ndarray, "constraints border"]
    constraint_variance: Float[np.ndarray, "constraints"]

    def variance_by_pictures(self, inverse: FeatureBlocks) -> Float[np.ndarray, "constraints"]:
        """Return the variances that the pictures alone leave the constraints' numbers.

        Unknowns that only constraints determine, such as their planes, are treated as known here.
        """
        A, precision = self.feature_constraints, np.diagonal(self.border)
        # Each unknown of the border separately, which is enough for a scale.
        known = np.divide(1.0, precision, out=np.zeros(len(precision)), where=precision > 0.0)
        spread = np.einsum("cr,rc->c", A, inverse.times(A.T))
        return np.maximum(spread + self.border_constraints**2 @ known, np.finfo(float).tiny)

    def factorised(self, damping: float = 0.0) -> "Factorisation":
        """Return the inverse in parts, with the diagonals of H and P multiplied by 1 + damping."""
        # Substituting dx = -H^-1 (g + B db + A^T m) into the other two rows gives
        #     (D - X^T H^-1 X) y = r - X^T H^-1 f,   X = [B A^T],   D = [[P, C^T], [C, -S]].
        inverse = self.features.damped(damping).inverse()
        coupling = np.concatenate([self.feature_border, self.feature_constraints.T], axis=1)
        eliminated = inverse.times(coupling)
        border = self.border * (1.0 + damping * np.eye(len(self.border)))
        C, reduced_by = self.border_constraints, coupling.T @ eliminated
        size = len(border)
        exact = EXACT_VARIANCE * self.variance_by_pictures(inverse)
        S = np.diag(np.maximum(self.constraint_variance, exact))
        reduced = np.block([[border, C.T], [C, -S]]) - reduced_by
        return Factorisation(inverse, coupling, eliminated, _symmetric_inverse(reduced), size)


def _symmetric_inverse(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the inverse of a symmetric indefinite matrix, scaled to a unit diagonal."""
    if not len(matrix):
        return matrix
    # The matrix mixes numbers of a calibration, metres and constraints: without scaling the inverse
    # would lose most digits.
    scale = np.sqrt(np.abs(np.diagonal(matrix)))
    # A plane has no information itself: it is scaled by its constraints.
    largest = np.abs(matrix).max(axis=1, initial=0.0)
    scale = np.where(scale > 0.0, scale, np.sqrt(np.where(largest > 0.0, largest, 1.0)))
    outer = np.outer(scale, scale)
    return np.linalg.inv(matrix / outer) / outer


class Factorisation(NamedTuple):
    """The inverse of a constrained system, in parts.

    Attributes:
        features: H^-1.
        coupling: B and A^T side by side.
        eliminated: H^-1 times the coupling.
        reduced: inverse of the remaining system for border and multipliers.
        border_size: number of unknowns of the border.
    """

    features: FeatureBlocks
    coupling: Float[np.ndarray, "rows reduced"]
    eliminated: Float[np.ndarray, "rows reduced"]
    reduced: Float[np.ndarray, "reduced reduced"]
    border_size: int

    def solve(
        self,
        features: Float[np.ndarray, "rows *columns"],
        reduced: Float[np.ndarray, "reduced *columns"],
    ) -> tuple[Float[np.ndarray, "rows *columns"], Float[np.ndarray, "reduced *columns"]]:
        """Return the solution for a right-hand side, split into features and the reduced rest."""
        rest = self.reduced @ (reduced - self.eliminated.T @ features)
        return self.features.times(features) - self.eliminated @ rest, rest

    def covariance(self, rows: np.ndarray) -> Float[np.ndarray, "chosen chosen"]:
        """Return the covariance of some unknowns: rows of features, then of the border."""
        # Columns of the inverse: one solution for each requested unknown.
        size, count = self.features.size, len(rows)
        is_feature = rows < size
        right = np.zeros((size, count)), np.zeros((len(self.reduced), count))
        for k, row in enumerate(rows):
            right[0 if is_feature[k] else 1][row if is_feature[k] else row - size, k] = 1.0
        features, rest = self.solve(*right)
        covariance = np.where(
            is_feature[:, None],
            features[np.where(is_feature, rows, 0)],
            rest[np.where(is_feature, 0, rows - size)] if len(rest) else 0.0,
        )
        # Remove the asymmetry due to rounding.
        return 0.5 * (covariance + covariance.T)

    def feature_blocks(self) -> FeatureBlocks:
        """Return the covariance of each feature separately."""
        split = 3 * len(self.features.points)
        blocks = []
        for block, part, n in (
            (self.features.points, self.eliminated[:split], 3),
            (self.features.lines, self.eliminated[split:], 4),
        ):
            spread = part.reshape(len(block), n, len(self.reduced))
            # H^-1 + H^-1 X R^-1 X^T H^-1
            blocks.append(block + (spread @ self.reduced) @ spread.swapaxes(1, 2))
        return FeatureBlocks(*blocks)
