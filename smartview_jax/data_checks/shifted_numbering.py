"""Find views whose target points are numbered one or two columns or rows off.

A detector that misses the outermost column of a board and counts from the next one shifts all
numbers of that view. Its points fit the target exactly, and its pose is wrong by the width of a
column, so that only the robot tells. The views that see too much of the board to be shifted are
fitted first, or all views where those are few; a view that lies nearest to a shifted numbering is
then taken as shifted, until nothing changes. Shifts are named where they are likely, by Schwarz's
criterion, remove most of the misfit and concern fewer than half of the views.
"""

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from ..geometry import host_matrices
from .changes import ChangeOptions
from .closure import Poses, explains_most
from .misfit_evidence import errors_of, evidence
from .transform_fit import fit_transforms, mean_misfit, median_distance

MAX_STEPS = 2
"""Largest number of columns, and of rows, by which a view may be shifted."""

MIN_CERTAIN_VIEWS = 4
"""Fewest views that cannot be shifted to which transforms are fitted without the others."""

MAX_ROUNDS = 10
"""Largest number of rounds in which views are assigned."""

MAX_DISTANCE_TO_SHIFT = 0.2
"""Largest distance of a view from a shifted numbering, in parts of the shift. Views that scatter by
more than a column lie as near to one by chance in one of ten."""

_SAME_POINT = 1e-4
"""Distance of two points, in parts of the target's size, that is a rounding error."""


def find_shifted_numbering(
    mount_from_holder: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    points: Float[np.ndarray, "views points 3"],
    seen: Bool[np.ndarray, "views points"],
    options: ChangeOptions | None = None,
) -> dict[int, Float[np.ndarray, "3"]]:
    """Return, by view, from its points as numbered to the ones it shows, m; empty if none is off.

    Args:
        mount_from_holder: the robot's part of the chain, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        points: points of the target as numbered.
        seen: mask of the points that agree with the view's pose.
        options: the odds and the misfit from which a fault is looked for.
    """
    options = options or ChangeOptions()
    robot, camera = host_matrices(mount_from_holder), host_matrices(camera_from_world)
    views = np.flatnonzero(used & seen.any(axis=1) & np.isfinite([robot, camera]).all((0, 2, 3)))
    robot, camera = robot[views], camera[views]
    everything = np.ones(len(views), dtype=bool)
    if len(views) <= MIN_CERTAIN_VIEWS:
        return {}
    given = fit_transforms(robot, camera).closure
    distance = median_distance(camera)
    _, score = mean_misfit(given, distance)
    if score < options.min_score:
        return {}
    board = np.unique(points[views][seen[views]], axis=0)
    shifts = possible_shifts(board)
    board_tree = KDTree(board)
    tolerance = _SAME_POINT * float(np.ptp(board, axis=0).max())
    choices = [
        np.array(
            [np.zeros(3)]
            + [v for v in shifts if (board_tree.query(shown + v)[0] < tolerance).all()]
        )
        for shown in (points[view, seen[view]] for view in views)
    ]
    certain = np.array([len(choice) == 1 for choice in choices])
    if certain.all():
        return {}
    fitted = certain if certain.sum() >= MIN_CERTAIN_VIEWS else everything
    centres = np.array([points[view, seen[view]].mean(axis=0) for view in views])
    chosen = np.zeros((len(views), 3))
    for _ in range(MAX_ROUNDS):
        offsets = _offsets(robot, camera, fitted, chosen, centres)
        nearest = np.array(
            [
                choice[np.linalg.norm(choice - offset, axis=1).argmin()]
                for choice, offset in zip(choices, offsets, strict=True)
            ]
        )
        is_settled, chosen = fitted.all() and np.array_equal(nearest, chosen), nearest
        fitted = everything
        if is_settled:
            break
    shifted = chosen.any(axis=1)
    corrected = fit_transforms(robot, _renumbered(camera, chosen)).closure
    # Every view might have been shifted in so many ways.
    ways = 2.0 * float(np.sum(np.log([len(choice) for choice in choices])))
    gain = evidence(errors_of(given), errors_of(corrected), 0) - ways
    is_likely = gain > 2.0 * np.log(options.min_odds)
    miss = np.linalg.norm(_offsets(robot, camera, everything, chosen, centres) - chosen, axis=1)
    is_resolved = miss[shifted] < MAX_DISTANCE_TO_SHIFT * np.linalg.norm(chosen[shifted], axis=1)
    if (
        is_likely
        and is_resolved.all()
        and 0 < 2 * shifted.sum() < len(views)
        and explains_most(mean_misfit(corrected, distance)[1], score)
    ):
        return {int(views[k]): chosen[k] for k in np.flatnonzero(shifted)}
    return {}


def shift_text(shift: Float[np.ndarray, "3"]) -> str:
    """Return a shift of the numbering in words, as the reason why its view is left out."""
    along = " and ".join(
        f"{1e3 * abs(length):.3g} mm along the target's {'-' if length < 0.0 else ''}{axis}"
        for axis, length in zip("xyz", shift, strict=True)
        if length
    )
    return (
        f"its points are numbered wrongly, by whole columns or rows: they lie {along} from where "
        "their numbers say, by the poses of the other views. Number them again"
    )


def possible_shifts(board: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "shifts 3"]:
    """Return the shifts by one or two columns and rows that take half of a grid into itself, m."""
    size = float(np.ptp(board, axis=0).max())
    steps = []
    for axis in range(2):
        values = np.unique(board[:, axis])
        # Numbers that differ by rounding are one column.
        values = values[np.diff(values, prepend=-np.inf) > _SAME_POINT * size]
        lengths = values[1 : 1 + MAX_STEPS] - values[0]
        steps.append(np.concatenate([-lengths[::-1], [0.0], lengths]))
    along = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    shifts = np.pad(along[along.any(axis=1)], ((0, 0), (0, 1)))
    distances, _ = KDTree(board).query(board + shifts[:, None])
    return shifts[np.mean(distances < _SAME_POINT * size, axis=1) >= 0.5]


def _renumbered(camera: Poses, shifts: Float[np.ndarray, "views 3"]) -> Poses:
    """Return the camera's poses with the points of each view shifted."""
    # camera @ points stays as it was seen, with points + shift in place of the points.
    corrected = camera.copy()
    corrected[:, :3, 3] -= (camera[:, :3, :3] @ shifts[:, :, None])[..., 0]
    return corrected


def _offsets(
    robot: Poses,
    camera: Poses,
    fitted: Bool[np.ndarray, "views"],
    shifts: Float[np.ndarray, "views 3"],
    centres: Float[np.ndarray, "views 3"],
) -> Float[np.ndarray, "views 3"]:
    """Return how far the seen points lie from their numbers' by the transforms of some views, m.

    Args:
        robot, camera: poses of the views.
        fitted: the views to which the transforms are fitted.
        shifts: by which these are renumbered.
        centres: centres of the seen points of each view as numbered.
    """
    fit = fit_transforms(robot, _renumbered(camera, shifts), fitted)
    # closure = H^-1 C X^-1 T^-1; the target's frame in the picture is X^-1 T^-1 closure T X.
    chain = robot @ fit.holder_from_world
    seen = np.linalg.inv(chain) @ np.linalg.inv(fit.camera_from_mount) @ camera
    return (seen[:, :3, :3] @ centres[:, :, None])[..., 0] + seen[:, :3, 3] - centres
