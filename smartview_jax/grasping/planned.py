"""Hold a planned grasp: its robot commands, their checks, and its probability of success."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxlie import SE3
from jaxtyping import Float

from ..geometry import host_transforms, xyzoat
from ..io import HandSteps, write_viewpoints
from ..modeling import Grasp

PHASES = ("pre_grasp", "grasp", "lift", "retreat")
"""The poses of a grasp in order of execution; the gripper closes at the second."""

STRAIGHT = (False, True, True, True)
"""Whether the tool moves to each of the `PHASES` in a straight line, which was checked."""

LISTED_REASONS = 6
"""Largest number of reasons in the summary of a plan without a safe grasp."""


@dataclasses.dataclass(frozen=True, eq=False)
class PlannedGrasp:
    """A grasp of a found object, from the approach to the retreat.

    Attributes:
        grasp: the model's grasp.
        world_from_gripper: pose of the gripper's frame in each of the `PHASES`, m.
        base_from_tool: commands for these poses, with the robot's error compensated (Eq. 20), 4x4,
            m.
        joints: the same as joint readings, rad (m for a prismatic joint); None without an arm.
        opening: distance between the fingers until they close, m.
        width: width of the object between the fingers, m.
        success_probability: probability, by the covariances, that the object ends up between the
            fingers and nothing else is touched; NaN where it was not computed.
        risks: probability that each condition fails, by its name.
        clearance: smallest distance of the gripper from an obstacle during the motion, m.
        reasons: why the grasp is refused; empty if it is safe.
    """

    grasp: Grasp
    world_from_gripper: Float[np.ndarray, "4 4 4"]
    base_from_tool: Float[np.ndarray, "4 4 4"]
    joints: Float[np.ndarray, "4 joints"] | None
    opening: float
    width: float
    success_probability: float
    risks: dict[str, float]
    clearance: float
    reasons: tuple[str, ...] = ()

    @property
    def is_safe(self) -> bool:
        """Whether there is no reason against the grasp."""
        return not self.reasons

    @property
    def checks_passed(self) -> int:
        """The number of checks passed, of three: collisions, arm, probability of success."""
        if self.is_safe:
            return 3
        # Each is computed only if the previous one passed.
        if np.isfinite(self.success_probability):
            return 2
        return int(np.isfinite(self.base_from_tool).any())

    @property
    def poses(self) -> SE3:
        """The commands `base_from_tool` as transforms, `(4)`."""
        return host_transforms(self.base_from_tool)

    @property
    def xyzoat(self) -> Float[np.ndarray, "4 6"]:
        """The commands in VAL's form: x, y, z in m and O, A, T in rad (Eq. 18)."""
        return np.asarray(xyzoat(self.poses))

    @property
    def hand(self) -> HandSteps:
        """The kind of motion to each pose, and the distance of the fingers during it."""
        closed_after = PHASES.index("grasp")
        openings = (self.opening if k <= closed_after else 0.0 for k in range(len(PHASES)))
        return HandSteps(STRAIGHT, tuple(openings))

    def write(self, path: str | Path, pose_format: str = "val_oat") -> None:
        """Write the commands for a robot: VAL, CSV or JSON, as `io.write_viewpoints` does.

        The fingers open before the tool starts, and close at the grasp. From the pre-grasp on the
        tool moves in straight lines, which were checked for collisions. The motion to the pre-grasp
        was not.

        Args:
            path: a file ending in .val, .csv or .json.
            pose_format: of CSV and JSON, the manufacturer's, as in `io.write_viewpoints`.

        Raises:
            ValueError: the grasp is refused, or the ending or the format is not known.
        """
        # Anyone who finds the file of a refused grasp might execute it.
        if not self.is_safe:
            raise ValueError(f"the grasp is not written: {'; '.join(self.reasons)}")
        write_viewpoints(path, self.poses, PHASES, self.joints, pose_format, self.hand)


class NoSafeGraspError(ValueError):
    """The error that no grasp of an object is safe; its text gives the reasons."""


@dataclasses.dataclass(frozen=True, eq=False)
class GraspPlan:
    """All grasps of a found object that were tried, the best first.

    Attributes:
        safe: grasps that may be executed, by probability of success.
        refused: the others, each with its reasons.
        object_name: for messages.
    """

    safe: tuple[PlannedGrasp, ...]
    refused: tuple[PlannedGrasp, ...]
    object_name: str = ""

    def __iter__(self) -> Iterator[PlannedGrasp]:
        """Go through the safe grasps, the best first."""
        return iter(self.safe)

    def __len__(self) -> int:
        """Return the number of safe grasps."""
        return len(self.safe)

    @property
    def best(self) -> PlannedGrasp:
        """The safe grasp that is most likely to succeed; a NoSafeGraspError if there is none."""
        if not self.safe:
            raise NoSafeGraspError(self.summary)
        return self.safe[0]

    @property
    def summary(self) -> str:
        """The best grasp in words, or why there is none.

        Each reason comes with its number of grasps, the reasons of the latest checks first.
        """
        subject = self.object_name or "the object"
        if self.safe:
            best = self.safe[0]
            return (
                f"{subject}: {len(self.safe)} of {len(self.safe) + len(self.refused)} grasps are "
                f"safe; the best ({best.grasp.name}) succeeds with "
                f"{best.success_probability:.1%}"
            )
        if not self.refused:
            return f"no safe grasp: the model of {subject} has no place for this gripper"
        return f"no safe grasp of {subject}: {len(self.refused)} tried; {self._reasons()}"

    def _reasons(self) -> str:
        """Return why grasps were refused, each reason with its number of grasps."""
        # The same reason often refuses many grasps: it is listed once, with their number.
        counts = Counter(reason for grasp in self.refused for reason in grasp.reasons)
        # Every reason belongs to one check, so that all its grasps passed equally many checks.
        furthest = {r: grasp.checks_passed for grasp in self.refused for r in grasp.reasons}
        # Reasons of grasps that passed most checks come first, however many failed earlier.
        ranked = sorted(counts, key=lambda reason: (-furthest[reason], -counts[reason]))
        listed = "; ".join(f"{counts[r]} of them: {r}" for r in ranked[:LISTED_REASONS])
        others = len(counts) - LISTED_REASONS
        return listed + (f"; and {others} other reasons" if others > 0 else "")
