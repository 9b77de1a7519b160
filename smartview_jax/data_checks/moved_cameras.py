"""Find the camera of a rig that was knocked, or whose lens zoomed, between two states.

Two cameras on one hand, or two next to the arm, have one relative pose in all states, which follows
from their pictures alone. If it is another one from some state on, one of them was moved, however
weak the robot is. Which one is told by a third camera against which the other did not move, or else
by the robot, if it is good enough.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from ..dataset import Rig
from ..geometry import as_se3, host_matrices, mean_matrix
from .changes import Change, ChangeOptions, ChangeReport, evidence_of_change, find_change
from .closure import Poses
from .misfit_evidence import STRONG_EVIDENCE
from .rig_states import MAX_LEFT_OVER, SeenTarget, pairs_with_one_target, states_in_common
from .transform_fit import median_distance, misfit_text, misfits

_Pair = tuple[str, str]


class MovedCamera(NamedTuple):
    """A camera that was moved against another one.

    Attributes:
        pair: names of two cameras whose relative pose changed.
        suspects: the one of them that was moved, or both if nothing tells which.
        view: name of the first state after the change.
        report: the change, of the second camera's poses against the first one's.
    """

    pair: _Pair
    suspects: tuple[str, ...]
    view: str
    report: ChangeReport

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right for the states before the change and after it."""
        return self.report.contradicts

    @property
    def sentence(self) -> str:
        """The camera that was moved, from which state on, and what to do, in words."""
        causes = ", or as if ".join(self._cause(change) for change in self.report.changes)
        first, second = self.pair
        return (
            f"from view {self.view} on, the pictures of cameras {first!r} and {second!r} "
            f"contradict the earlier ones, as if {causes}: with such a change the relative pose of "
            f"the cameras varies by {misfit_text(self.report.changes[0].misfit)} instead of "
            f"{misfit_text(self.report.misfit)} (means over the states, from pictures alone). "
            "Calibrate the two parts separately"
        )

    def _cause(self, change: Change) -> str:
        """Return what may have been changed, and by how much, as a clause."""
        if change.kind == "zoom":
            zoom = 100.0 * (change.zoom - 1.0)
            return f"the lens of camera {self.pair[1]!r} had zoomed by {zoom:+.1f} %"
        if change.turn is not None:
            names = " or ".join(map(repr, self.suspects))
            return f"the pictures of camera {names} had been {change.turn.text}"
        by = f"by {misfit_text((change.translation, change.rotation))}"
        if change.kind == "target":
            return f"a target had been moved that only one of them sees {by}"
        return f"camera {' or '.join(map(repr, self.suspects))} had been moved on its mount {by}"


def find_moved_cameras(rig: Rig, seen: Mapping[str, SeenTarget]) -> tuple[MovedCamera, ...]:
    """Return the cameras that were moved against others on their mount, each once.

    Args:
        rig: data sets of the cameras.
        seen: the target as each camera sees it; cameras that are not listed are not compared.
    """
    moved: dict[tuple[str, ...], MovedCamera] = {}
    pairs = tuple(pairs_with_one_target(rig, seen))
    # Of so many good pairs, each tried in both orders, some pair would change by chance.
    options = ChangeOptions(min_odds=2 * len(pairs) * STRONG_EVIDENCE)
    for pair in pairs:
        # A zoom is tested for the lens of the second camera alone.
        both = [_change(rig, order, seen, options) for order in ((pair[1], pair[0]), pair)]
        changes = [change for change in both if change is not None]
        if not changes:
            continue
        kept = {name for name in pair if _keeps_its_place(rig, name, changes[0], seen)}
        suspects = tuple(name for name in pair if name not in kept) or pair
        if len(suspects) > 1:
            suspects = _suspects_by_robot(rig, pair, seen, changes[0].view)
        of_suspects = [change for change in changes if change.pair[1] in suspects] or changes
        best = min(of_suspects, key=lambda change: change.report.changes[0].score)
        moved.setdefault(suspects, best._replace(suspects=suspects))
    return tuple(moved.values())


def _states_by_time(
    rig: Rig, pair: _Pair, seen: Mapping[str, SeenTarget]
) -> tuple[Int[np.ndarray, "states"], Poses, Poses]:
    """Return the states in common, and the target's poses, in the order of the first camera.

    The rig lists last which states its own first camera did not see.
    """
    states, in_first, in_second = states_in_common(rig, *pair, seen)
    _, places, _ = np.intersect1d(rig.state_index[pair[0]], states, return_indices=True)
    order = np.argsort(places)
    return states[order], in_first[order], in_second[order]


def _keeps_its_place(
    rig: Rig, camera: str, change: MovedCamera, seen: Mapping[str, SeenTarget]
) -> bool:
    """Return whether a third camera tells that a camera of a pair that changed was not moved.

    Against it the camera's mean pose is then about the same before the change as after it.
    """
    state = rig.view_ids.index(change.view)
    place = int(np.flatnonzero(rig.state_index[camera] == state)[0])
    for pair in pairs_with_one_target(rig, seen):
        if camera not in pair or set(pair) == set(change.pair):
            continue
        states, in_first, in_second = states_in_common(rig, *pair, seen)
        after = np.isin(states, rig.state_index[camera][place:])
        if min(after.sum(), (~after).sum()) < ChangeOptions().min_views_on_a_side:
            continue
        relative = in_second @ np.linalg.inv(in_first)
        means = [mean_matrix(relative[part], np.ones(part.sum())) for part in (~after, after)]
        translation, rotation = misfits(np.linalg.inv(means[0]) @ means[1]).tolist()
        size = rotation + translation / median_distance(in_first)
        if size < 0.5 * change.report.changes[0].size:
            return True
    return False


def _change(
    rig: Rig, pair: _Pair, seen: Mapping[str, SeenTarget], options: ChangeOptions
) -> MovedCamera | None:
    """Return the change of the second camera's poses against the first one's; None without one."""
    states, in_first, in_second = _states_by_time(rig, pair, seen)
    used = np.ones(len(states), dtype=bool)
    report = find_change(as_se3(in_first), as_se3(in_second), used, options=options)
    if report is None or report.changes[0].score > MAX_LEFT_OVER * report.score:
        return None
    return MovedCamera(pair, pair, rig.view_ids[states[report.changes[0].first_view]], report)


def _suspects_by_robot(
    rig: Rig, pair: _Pair, seen: Mapping[str, SeenTarget], view: str
) -> tuple[str, ...]:
    """Return which of two cameras was moved against the robot, or both if it does not tell."""
    state = rig.view_ids.index(view)
    evidence = [_evidence_by_robot(rig, name, seen[name], state) for name in pair]
    # A camera with fewer views has less evidence against it even where the robot tells nothing.
    least = 2.0 * np.log(STRONG_EVIDENCE)
    if max(evidence) < least or max(evidence) - min(evidence) < least:
        return pair
    return (pair[int(np.argmax(evidence))],)


def _evidence_by_robot(rig: Rig, camera: str, seen: SeenTarget, state: int) -> float:
    """Return the evidence that a camera was moved against the robot before a state."""
    data = rig.cameras[camera]
    robot = host_matrices(data.mount_from_holder)[seen.views]
    states = rig.state_index[camera][seen.views]
    first_view = int(np.flatnonzero(states == state)[0])
    return evidence_of_change(as_se3(robot), as_se3(seen.camera_from_world), first_view)
