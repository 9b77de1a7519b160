"""Find out that an arm is of another type than described, by the positions of camera and joints.

Arms of one family have the same axes but links of other lengths. Their rotations then agree with
the camera's, and only positions do not. They are linear in the lengths of the links (`d` and `a` of
Denavit and Hartenberg), so the lengths that the camera's motion wants follow by least squares. A
target of another size than stated is the other explanation, and changes all lengths alike.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import host_mount_from_holder, mount_frames
from ..geometry import host_matrices
from ..robots import SerialArm
from .closure import MAX_CORRECTED_SCORE_RATIO
from .misfit_evidence import VERY_STRONG_EVIDENCE
from .position_equations import (
    Columns,
    PositionFit,
    evidence_of_positions,
    fit_positions,
    robot_column,
    transform_columns,
)
from .transform_fit import Matrix, fit_transforms, motions_of_views

MAX_NAMED_LENGTHS, MIN_NAMED_CHANGE = 4, 2e-3
"""Largest number of lengths that a sentence names, and their smallest difference, m."""


MIN_LENGTH_CHANGE = 0.01
"""Smallest difference of a length, m, that makes another arm.

Arms of one type differ by less than a millimetre, and types of one family by centimetres.
"""

MAX_LENGTH_STD = 0.01
"""Largest standard deviation of a length that is told, m."""


class LinkLengths(NamedTuple):
    """The lengths of an arm's links that the camera's motion wants.

    Attributes:
        names: of the lengths that the motion tells, such as `a of link 2`.
        given, wanted: these lengths, m.
        given_misfit: mean error of the positions with the lengths as described, m.
        misfit: the same with the lengths that the motion wants, m.
        size_misfit: the same with a target of another size, m.
    """

    names: tuple[str, ...]
    given: Float[np.ndarray, "lengths"]
    wanted: Float[np.ndarray, "lengths"]
    given_misfit: float
    misfit: float
    size_misfit: float

    @property
    def sentence(self) -> str:
        """The fault of the arm's description in words, and what to do."""
        by_change = np.argsort(-np.abs(self.wanted - self.given))
        lengths = ", ".join(
            f"{self.names[k]} is {1e3 * self.wanted[k]:.0f} mm, not {1e3 * self.given[k]:.0f}"
            for k in by_change[:MAX_NAMED_LENGTHS]
            if abs(self.wanted[k] - self.given[k]) > MIN_NAMED_CHANGE
        )
        return (
            "the arm is of another type than described: robot and camera turn alike, but their "
            f"positions differ by {1e3 * self.given_misfit:.3g} mm (mean), and by only "
            f"{1e3 * self.misfit:.3g} mm if {lengths}. (A target of another size would leave "
            f"{1e3 * self.size_misfit:.3g} mm.) Describe the arm that took these pictures"
        )


def find_other_arm(
    readings: Float[np.ndarray, "views joints"],
    arm: SerialArm,
    camera_from_world: SE3,
    mount: str,
    used: Bool[np.ndarray, "views"],
) -> LinkLengths | None:
    """Return lengths of the arm's links that explain the camera's motion, if the described do not.

    Args:
        readings: joint readings, rad, or m for a prismatic joint.
        arm: as described.
        camera_from_world: from the pictures alone, `(views)`.
        mount: where the camera is stated to be.
        used: mask of the views to use.

    Returns:
        None if the lengths as described, or a target of another size, explain the motion as well.
    """
    views = np.flatnonzero(used)
    # Positions, twice as many as both transforms, the size, and two lengths for each joint.
    if 3 * len(views) < 2 * (7 + 2 * arm.joint_count) or mount not in (
        "eye_in_hand",
        "eye_to_hand",
    ):
        return None
    tool_poses = arm.base_from_tool(readings)
    motions = motions_of_views(
        host_mount_from_holder(mount, tool_poses), camera_from_world, views, 1.0
    )
    if motions is None:
        return None
    robot, camera = motions
    fit = fit_transforms(robot, camera)
    turn_error = float(fit.misfit[:, 1].mean())
    positions, common = camera[:, :3, 3], transform_columns(robot, fit.camera_from_mount)
    reported = robot_column(robot, fit.camera_from_mount)
    as_given = fit_positions(common, positions - reported[..., 0])
    of_other_size = fit_positions(np.concatenate([common, reported], axis=2), positions)
    # Joints that are off by an angle move the tool by this angle times the reach.
    if of_other_size.mean_error < _reach(arm) * turn_error:
        return None
    of_lengths = _length_columns(readings, arm, mount, fit.camera_from_mount)[views]
    columns = np.concatenate([common, of_lengths], axis=2)
    of_other_arm = fit_positions(columns, positions - reported[..., 0])
    if of_other_arm.mean_error > MAX_CORRECTED_SCORE_RATIO * of_other_size.mean_error:
        return None
    rank = int(np.linalg.matrix_rank(columns.reshape(-1, columns.shape[2])))
    odds = evidence_of_positions(of_other_size, of_other_arm, rank - 7)
    if odds < 2.0 * np.log(VERY_STRONG_EVIDENCE):
        return None
    told = _told_columns(columns, of_other_arm, MAX_LENGTH_STD)[6:]
    changes = of_other_arm.numbers[6:][told]
    if not (np.abs(changes) > MIN_LENGTH_CHANGE).any():
        return None
    names = [f"{kind} of link {k + 1}" for kind in "da" for k in range(arm.joint_count)]
    given = np.concatenate([np.asarray(arm.d), np.asarray(arm.a)])[told]
    return LinkLengths(
        tuple(name for name, is_told in zip(names, told, strict=True) if is_told),
        given,
        given + changes,
        as_given.mean_error,
        of_other_arm.mean_error,
        of_other_size.mean_error,
    )


def _reach(arm: SerialArm) -> float:
    """Return the sum of an arm's lengths, m."""
    return float(np.abs(np.asarray(arm.d)).sum() + np.abs(np.asarray(arm.a)).sum())


def _length_columns(
    readings: Float[np.ndarray, "views joints"],
    arm: SerialArm,
    mount: str,
    camera_from_mount: Matrix,
) -> Columns:
    """Return how the target moves before the camera for each length of a link, first `d`, then `a`.

    The poses are linear in the lengths, so that the difference by a metre is exact.
    """
    given = host_matrices(arm.base_from_tool(readings))
    moved = []
    for kind in "da":
        for joint in range(arm.joint_count):
            lengths = np.array(getattr(arm, kind))
            lengths[joint] += 1.0
            longer = dataclasses.replace(arm, **{kind: lengths})
            moved.append(host_matrices(longer.base_from_tool(readings))[:, :3, 3] - given[:, :3, 3])
    columns = np.stack(moved, axis=2)
    if mount_frames(mount)[0] == "tool":
        columns = -given[:, :3, :3].swapaxes(1, 2) @ columns
    return camera_from_mount[:3, :3] @ columns


def _told_columns(
    columns: Columns, fit: PositionFit, max_std: float
) -> Bool[np.ndarray, "numbers"]:
    """Return which numbers of a fit the positions tell by themselves.

    Args:
        columns: of the fit.
        fit: the fit.
        max_std: largest standard deviation of such a number.
    """
    matrix = columns.reshape(-1, columns.shape[2])
    sizes = np.maximum(np.linalg.norm(matrix, axis=0), 1e-12)
    _, values, directions = np.linalg.svd(matrix / sizes, full_matrices=False)
    freedom = max(matrix.shape[0] - matrix.shape[1], 1)
    sigma = np.sqrt(np.sum(fit.errors**2) / freedom)
    # A direction that nothing determines has any size.
    inverse = np.where(values > 1e-6 * values[0], 1.0 / np.maximum(values, 1e-300), np.inf)
    with np.errstate(invalid="ignore"):
        shares = np.where(np.abs(directions) > 1e-6, directions * inverse[:, None], 0.0)
    return sigma * np.linalg.norm(shares, axis=0) / sizes < max_std
