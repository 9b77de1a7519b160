"""Plan the next states of a robot with several cameras, for `smartview plan`."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import smartview_jax as sv

from .plan_words import give_no_commands, new_names, plan_entries, plan_words
from .robot_commands import CommandSheet, RobotOptions
from .terminal import print_lines, progress_line


def is_rig_plan(paths: Sequence[Path], first: bool) -> bool:
    """Return whether the next states of a robot with several cameras are to be planned."""
    if not (paths[-1].is_dir() and sv.io.is_rig_folder(paths[-1])):
        return False
    if first:
        raise ValueError(
            f"--start: {paths[-1]} has several cameras: plan the first views of one of them, in a "
            "folder with this camera alone (smartview new), and take them with all cameras"
        )
    if len(paths) != 2 or not sv.joint.is_rig(paths[0]):
        raise ValueError(
            f"{paths[-1]} has several cameras: expected the folder RESULTS that smartview "
            f"calibrate {paths[-1]} --out RESULTS writes, with {sv.joint.RIG_FILE}, and this "
            "folder; of several arms, the file of the arm to plan for, such as "
            f"left{sv.joint.JOINT_SUFFIX}"
        )
    return True


def plan_rig(
    paths: Sequence[Path],
    limits: "sv.viewpoints.ViewLimits",
    stop: "sv.viewpoints.StopRule",
    robot: RobotOptions,
    json: bool,
) -> None:
    """Print commands of the states to take next, best first, and the error they lead to.

    The paths are the folder of the calibrations, or one arm's file, and the data-set folder.
    """
    folder = paths[0] if paths[0].is_dir() else paths[0].parent
    with progress_line() as progress:
        progress("reading the calibrations and their data set")
        estimate = sv.load_rig_estimate(paths[0])
        rig = sv.load_rig(paths[1], "mask", progress, keep_detections=False)
        rig = rig.of_arm(_arm_of(rig, estimate, paths))
        sigmas = {n: sv.load_estimate(folder / f"{n}.yaml").pixel_sigma for n in rig.cameras}
        calibration = next(iter(estimate.calibrations.values()))
        arm, readings = robot.arm_and_readings(calibration)
        progress("computing what the states so far tell")
        state_plan = sv.viewpoints.plan_states(
            sv.viewpoints.RigInformationModel.from_estimate(estimate, rig, sigmas),
            limits,
            stop,
            arm=arm,
            near=readings,
            progress=progress,
        )
    plan = state_plan.plan
    goal_mm = None if stop.goal is None else 1e3 * stop.goal
    names = new_names(rig.view_ids, len(state_plan.view_of))
    words = plan_words(plan, stop.least_gain, goal_mm, first=False)
    views = _seen_words(state_plan, names)
    sheet = CommandSheet(
        robot, calibration, names, state_plan.commands, arm, sv.viewpoints.SAFETY_CHECKS
    )
    say = partial(print_lines, *views, *words)
    entries = {**plan_entries(plan), "words": words, "seen": state_plan.seen}
    if names:
        sheet.give("plan", json, say, **entries)
    else:
        give_no_commands(entries, json)


def _arm_of(rig: "sv.Rig", estimate: "sv.joint.RigEstimate", paths: Sequence[Path]) -> str:
    for arm in rig.arm_names:
        if set(rig.of_arm(arm).cameras) == set(estimate.calibrations):
            return arm
    raise ValueError(
        f"{paths[0]}: expected the cameras of one arm of {paths[1]}, which has "
        f"{', '.join(rig.cameras)}; found {', '.join(estimate.calibrations)}"
    )


def _seen_words(state_plan: "sv.viewpoints.StatePlan", names: Sequence[str]) -> list[str]:
    """Return which cameras see their target in each state."""
    lines = []
    for row, (name, camera) in enumerate(zip(names, state_plan.view_of, strict=True)):
        others = [
            f"{other} sees {fractions[row]:.0%}"
            for other, fractions in state_plan.seen.items()
            if other != camera
        ]
        rest = f"; of the target {', '.join(others)}" if others else ""
        lines.append(f"{name}: a view of {camera}{rest}")
    return lines
