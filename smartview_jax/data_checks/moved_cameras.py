"""Find the camera of a rig that was knocked, or whose lens zoomed, between two states.

Two cameras on one hand, or two next to the arm, have one relative pose in all states, which follows
from their pictures alone. If it is another one from some state on, one of them was moved, however
weak the robot is. Which one is told by a third camera against which the other did not move, or else
by the robot, if it is good enough.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..calibration import host_mount_from_holder
from ..dataset import Rig
from ..geometry import as_se3, host_matrices
from .changes import Change, ChangeReport, evidence_of_change, find_change
from .misfit_evidence import STRONG_EVIDENCE
from .rig_states import (
    MAX_LEFT_OVER,
    MIN_COMMON_STATES,
    SeenTarget,
    pairs_with_one_target,
    states_in_common,
)
from .transform_fit import misfit_text

_Pair = tuple[str, str]


class MovedCamera(NamedTuple):
    """A camera that was moved against another one.

    Attributes:
        pair: names of two cameras whose relative pose changed.
        suspects: the one of them that was moved, or both if nothing tells which.
        view: name of the first state after the change.
        report: the change, of the last suspect's poses against the other camera's.
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
            return f"the lens of camera {self.suspects[-1]!r} had zoomed by {zoom:+.1f} %"
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
    changed: dict[_Pair, list[MovedCamera]] = {}
    unchanged: list[_Pair] = []
    for pair in pairs_with_one_target(rig, seen):
        # Of the lenses, only that of the second camera is asked whether it zoomed.
        both = [_change(rig, order, seen) for order in ((pair[1], pair[0]), pair)]
        if found := [change for change in both if change is not None]:
            changed[pair] = found
        elif len(states_in_common(rig, *pair, seen)[0]) >= MIN_COMMON_STATES:
            unchanged.append(pair)
    cleared = {name for pair in unchanged for name in pair}
    moved: dict[tuple[str, ...], MovedCamera] = {}
    for pair, changes in changed.items():
        suspects = tuple(name for name in pair if name not in cleared) or pair
        if len(suspects) > 1:
            suspects = _suspects_by_robot(rig, pair, seen, changes[0].view)
        of_suspects = [change for change in changes if change.pair[-1] in suspects] or changes
        best = min(of_suspects, key=lambda change: change.report.changes[0].score)
        moved.setdefault(suspects, best._replace(pair=pair, suspects=suspects))
    return tuple(moved.values())


def _change(rig: Rig, pair: _Pair, seen: Mapping[str, SeenTarget]) -> MovedCamera | None:
    """Return the change of the second camera's poses against the first one's; None without one."""
    states, in_first, in_second = states_in_common(rig, *pair, seen)
    # In the order of the first camera's views; the rig lists last what its own first did not see.
    order = np.argsort([list(rig.state_index[pair[0]]).index(state) for state in states])
    used = np.ones(len(order), dtype=bool)
    report = find_change(as_se3(in_first[order]), as_se3(in_second[order]), used)
    if report is None or report.changes[0].score > MAX_LEFT_OVER * report.score:
        return None
    view = rig.view_ids[states[order][report.changes[0].first_view]]
    return MovedCamera(pair, pair, view, report)


def _suspects_by_robot(
    rig: Rig, pair: _Pair, seen: Mapping[str, SeenTarget], view: str
) -> tuple[str, ...]:
    """Return which of two cameras was moved against the robot, or both if it does not tell."""
    state = rig.view_ids.index(view)
    evidence = [_evidence_by_robot(rig, name, seen[name], state) for name in pair]
    if abs(evidence[0] - evidence[1]) < 2.0 * np.log(STRONG_EVIDENCE):
        return pair
    return (pair[int(np.argmax(evidence))],)


def _evidence_by_robot(rig: Rig, camera: str, seen: SeenTarget, state: int) -> float:
    """Return the evidence that a camera was moved against the robot before a state."""
    data = rig.cameras[camera]
    robot = host_matrices(host_mount_from_holder(data.mount, data.base_from_tool))[seen.views]
    states = rig.state_index[camera][seen.views]
    first_view = int(np.flatnonzero(states == state)[0])
    return evidence_of_change(as_se3(robot), as_se3(seen.camera_from_world), first_view)
