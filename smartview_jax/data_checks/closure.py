"""Measure how well one hand-eye transform explains the motions of robot and camera.

`A X = X B` is solved over all pairs of views: the rotation of X by Park and Martin's method, then
its translation by least squares. The closure error is what remains, as a median over the pairs, so
that a few bad views do not dominate. A length scale between robot and camera is estimated as well
where the motion determines it. Everything is NumPy, over a batch of data sets at once where several
explanations of the same views are compared: one by one, their many small operations cost as much
as a fit.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..geometry import host_nearest_rotation, host_rotation_vectors

Poses = Float[np.ndarray, "*batch views 4 4"]
"""Homogeneous matrices, one per view, m."""

MAX_VIEWS = 40
"""Largest number of views compared, evenly spaced; their pairs are enough."""

MAX_SCALE_RELATIVE_STD = 0.1
"""Largest relative standard deviation at which a length scale counts as determined."""

MIN_RELATIVE_RESIDUAL = 1e-3
"""Smallest residual of a length scale's equations that is believed, over the target's distance."""

TRIMMING_ITERATIONS = 2
"""Number of times a fit is repeated without outlying pairs."""

MAX_CLOSURE_SCORE = 0.03
"""Closure score below which data are accepted: about 10 mm and a degree at half a metre."""

MAX_CORRECTED_SCORE_RATIO = 0.3
"""Ratio of corrected to given closure score below which a mistake counts as an explanation."""

MIN_EIGENVALUE = 1e-12
"""Smallest eigenvalue of normal equations, over the largest, that the motions determine: the square
of a part in a million, and far above rounding errors."""

CLOSURE_SCORE_FLOOR = 1e-4
"""Closure score treated as zero: 0.05 mm at half a metre, less than any robot's error."""


class ClosureError(NamedTuple):
    """The closure error that remains with the best hand-eye transform.

    Attributes:
        rotation: median over the pairs of views, rad.
        translation: median over the pairs, in the camera's unit of length, m.
        score: rotation plus translation divided by the distance to the target; the translation is
            in the robot's unit of length where that is the larger one, so that a hypothesis which
            shrinks the robot's motion does not shrink what it leaves.
    """

    rotation: float
    translation: float
    score: float


def explains_most(score: float, given_score: float) -> bool:
    """Return whether robot and camera agree far better with a mistake or a change than without."""
    return score < MAX_CORRECTED_SCORE_RATIO * given_score


def contradicts_calibration(score: float, given_score: float) -> bool:
    """Return whether no calibration can be right without what explains most of a large error.

    Args:
        score: closure score with the change that explains the error.
        given_score: without it.
    """
    return given_score > MAX_CLOSURE_SCORE and explains_most(score, given_score)


class RelativeMotions(NamedTuple):
    """The motions between pairs of views, expressed with the best hand-eye rotation R.

    The hand-eye translation t then solves
    `rotation_minus_identity t = robot_translation - camera_translation`.

    Attributes:
        rotation_minus_identity: `R_A - I` of every pair.
        robot_translation: translations of the robot's motions in the camera's axes, `R t_B`, m.
        camera_translation: translations of the camera's motions, `t_A`, m.
        rotation_error: angle between `R_A` and `R R_B R^T`, rad.
        target_distance: median distance of the target from the camera, m.
        second_axis_ratio: second over first singular value of the rotation vectors, of camera or
            robot, whichever is smaller. Near zero all rotations have the same axis, and the
            hand-eye rotation is not determined.
    """

    rotation_minus_identity: Float[np.ndarray, "*batch pairs 3 3"]
    robot_translation: Float[np.ndarray, "*batch pairs 3"]
    camera_translation: Float[np.ndarray, "*batch pairs 3"]
    rotation_error: Float[np.ndarray, "*batch pairs"]
    target_distance: Float[np.ndarray, "*batch"]
    second_axis_ratio: Float[np.ndarray, "*batch"]


def spread_views(count: int) -> Int[np.ndarray, "compared"]:
    """Return the indices of at most `MAX_VIEWS` of so many views, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, MAX_VIEWS).astype(int))


def relative_motions(mount_from_holder: Poses, camera_from_world: Poses) -> RelativeMotions:
    """Compute the motions of robot and camera between all pairs of three or more views."""
    indices = spread_views(camera_from_world.shape[-3])
    M, C = mount_from_holder[..., indices, :, :], camera_from_world[..., indices, :, :]
    i, j = np.triu_indices(len(indices), 1)
    A, B = (poses[..., j, :, :] @ np.linalg.inv(poses)[..., i, :, :] for poses in (C, M))
    a, b = host_rotation_vectors(A), host_rotation_vectors(B)
    # R_A R = R R_B: R takes the rotation vectors b to a (orthogonal Procrustes).
    R = host_nearest_rotation(a.swapaxes(-1, -2) @ b)
    # Repeated without outlying pairs: one wrong view spoils all pairs that contain it.
    for _ in range(TRIMMING_ITERATIONS):
        used = _inlier_pairs(np.linalg.norm(a - b @ R.swapaxes(-1, -2), axis=-1))
        R = host_nearest_rotation((used[..., None] * a).swapaxes(-1, -2) @ b)
    # The residual as the angle of a rotation, not as a difference of rotation vectors: for motions
    # near 180 degrees the axis may have either sign.
    of_pairs = R[..., None, :, :]
    expected = of_pairs @ B[..., :3, :3] @ of_pairs.swapaxes(-1, -2)
    cosine = 0.5 * (np.einsum("...pab,...pab->...p", A[..., :3, :3], expected) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    # The smaller ratio: where the robot turns about one axis only, all rotation of the camera about
    # a second one is noise, and a single bad view has much of it.
    vectors = np.stack([a, b])
    squares = np.maximum(np.linalg.eigvalsh(vectors.swapaxes(-1, -2) @ vectors), 0.0)
    ratios = np.sqrt(squares[..., 1]) / np.maximum(np.sqrt(squares[..., 2]), 1e-12)
    return RelativeMotions(
        A[..., :3, :3] - np.eye(3),
        B[..., :3, 3] @ R.swapaxes(-1, -2),
        A[..., :3, 3],
        angle,
        np.median(np.linalg.norm(C[..., :3, 3], axis=-1), axis=-1),
        np.min(ratios, axis=0),
    )


def closure_error(motions: RelativeMotions, scale: float = 1.0) -> ClosureError:
    """Return the closure error with the robot's positions multiplied by a scale."""
    return ClosureError(*closure_errors(motions, scale).tolist())


def closure_errors(
    motions: RelativeMotions, scales: float | Float[np.ndarray, "..."] = 1.0
) -> Float[np.ndarray, "... 3"]:
    """Return the numbers of `ClosureError` for every element of a batch.

    Args:
        motions: of one data set or of a batch.
        scales: factors of the robot's positions, which broadcast with the batch.
    """
    # (R_A - I) t = scale R t_B - t_A, the translations of A X = X B, solved for t over all pairs.
    right_hand_side = (
        np.asarray(scales)[..., None, None] * motions.robot_translation - motions.camera_translation
    )
    matrix, used = motions.rotation_minus_identity, np.ones(right_hand_side.shape[:-1])
    residual = _translation_residual(matrix, right_hand_side, used)
    for _ in range(TRIMMING_ITERATIONS):
        residual = _translation_residual(matrix, right_hand_side, _inlier_pairs(residual))
    translation = np.median(residual, axis=-1)
    rotation = np.broadcast_to(np.median(motions.rotation_error, axis=-1), translation.shape)
    score = rotation + translation / np.minimum(scales, 1.0) / motions.target_distance
    return np.stack([rotation, translation, score], axis=-1)


class LengthRatio(NamedTuple):
    """The ratio of the camera's motion to the robot's.

    Attributes:
        value: the ratio; 1 if it is not determined.
        std: its standard deviation; infinite if it is not determined.
    """

    value: float = 1.0
    std: float = np.inf


def length_ratio(motions: RelativeMotions) -> LengthRatio:
    """Estimate the ratio of camera motion to robot motion, where the views determine it.

    The unknowns are the hand-eye translation t and the ratio s in
    `rotation_minus_identity t - s robot_translation = -camera_translation`. An orbit about the
    target fits any ratio; its standard deviation is then large.
    """
    rows = np.concatenate(
        [motions.rotation_minus_identity, -motions.robot_translation[:, :, None]], axis=2
    ).reshape(-1, 4)
    # Columns are scaled to unit length, so that the rank decision does not depend on units.
    column_norms = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    right_hand_side = -motions.camera_translation.reshape(-1)
    solution, _, rank, _ = np.linalg.lstsq(rows / column_norms, right_hand_side, rcond=1e-6)
    if rank < 4 or not len(right_hand_side) > 4:
        return LengthRatio()
    residuals = right_hand_side - rows / column_norms @ solution
    # Variance of the scale for residuals of unit variance: the last entry of (J' J)^-1.
    unit_variance = np.linalg.inv((rows / column_norms).T @ (rows / column_norms))[3, 3]
    # n (n - 1) / 2 pairs of n views are not independent; count n of them as independent.
    view_count = 0.5 * (1.0 + np.sqrt(1.0 + 8.0 * len(motions.camera_translation)))
    # Three or four views can close better than any robot by chance.
    variance = max(
        float(np.mean(residuals**2)),
        (MIN_RELATIVE_RESIDUAL * float(motions.target_distance)) ** 2,
    )
    std = float(np.sqrt(unit_variance * variance * len(motions.camera_translation) / view_count))
    if std < MAX_SCALE_RELATIVE_STD * abs(solution[3]):
        return LengthRatio(*(float(number / column_norms[3]) for number in (solution[3], std)))
    return LengthRatio()


def _inlier_pairs(residual: Float[np.ndarray, "*batch pairs"]) -> np.ndarray:
    """Return which pairs have a residual within three times the median."""
    return residual <= 3.0 * np.median(residual, axis=-1, keepdims=True) + 1e-12


def _translation_residual(
    matrix: Float[np.ndarray, "... pairs 3 3"],
    right_hand_side: Float[np.ndarray, "... pairs 3"],
    used: np.ndarray,
) -> Float[np.ndarray, "... pairs"]:
    """Return the residual of `matrix t = right_hand_side`, m, with the t that fits best.

    Pairs count with the weights `used`, `(... pairs)`.
    """
    *batch, pairs = used.shape
    # A row of zeros changes neither the solution nor the rank.
    rows = (used[..., None, None] * matrix).reshape(*batch, 3 * pairs, 3)
    values = right_hand_side.reshape(*batch, 3 * pairs, 1)
    transposed = rows.swapaxes(-1, -2)
    normal = np.linalg.pinv(transposed @ rows, rcond=MIN_EIGENVALUE, hermitian=True)
    translation = normal @ (transposed @ values)
    return np.linalg.norm(
        (matrix @ translation[..., None, :, :])[..., 0] - right_hand_side, axis=-1
    )
