"""Grasps executed in physics: how often is the object really in the hand, and was that foretold?

A cell with errors of arm, lens and mounts that nobody is told is calibrated from 20 views of a
board (projected, with 0.05 px of noise, not rendered), by the staged pipeline and by the joint fit.
Then

- reliability: an object falls into the bin and is measured from two views with known errors on top
  of the calibration's, from small to large, so that the predicted probability takes all values;
  every grasp that nothing else forbids is executed, whatever its probability;
- picking: objects fall into the bin, pictures are rendered, `sv.localize` finds and verifies them,
  and the safest grasp of an accepted one is executed; the same scenes with either calibration.

A grasp succeeded if the object is between the fingers and above the bin after the lift, in the
physics; not by a formula.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from rich.progress import track
from scipy.stats import beta

import smartview_jax as sv
from smartview_jax.evaluation import CalibrationEstimate
from smartview_jax.geometry import (
    host_adjoints,
    host_exponentials,
    host_matrices,
    host_transforms,
    mean_matrix,
)
from smartview_jax.grasping import GraspScene, Motion, NoSafeGraspError, Obstacle, grasps_for
from smartview_jax.modeling import (
    CalibrationUncertainty,
    ObjectModel,
    SeenViews,
)
from smartview_jax.picking import Region, execute, pick
from smartview_jax.picking.calibrating import stacked_commands
from smartview_jax.robots import Command
from smartview_jax.simulation import (
    CellError,
    CellObject,
    SimulatedCell,
    box,
    look_at_from_above,
    prism,
    roofed_block,
    stepped_block,
)

BOARD_VIEWS, PIXEL_NOISE = 20, 0.05
"""Views of the board, and noise of its points, px."""

SPREAD = np.diag([3e-4, 3e-4, 3e-4, 4e-3, 4e-3, 4e-3]) ** 2
"""Covariance of the smallest errors with which an object is measured, m and rad."""

SCALES = (1.0, 6.0, 12.0, 20.0)
"""Factors of these errors."""

BINS = (0.0, 0.5, 0.8, 0.95, 1.0)
"""Borders of the predicted probabilities in the reliability table."""


class Rig(NamedTuple):
    """A cell with one of its calibrations."""

    cell: SimulatedCell
    calibration: sv.Calibration
    estimate: CalibrationEstimate | None


class Measured(NamedTuple):
    """An object as it was measured, with what its error shares with the calibration's."""

    model: ObjectModel
    world_from_object: np.ndarray
    covariance: np.ndarray
    calibration_jacobian: np.ndarray | None
    calibration_names: tuple[str, ...]


def solids() -> dict:
    """The objects, two of them symmetric."""
    hexagon = 0.02 * np.array([[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3.0])
    return {
        "box": box(0.06, 0.04, 0.03),
        "stepped": stepped_block(0.06),
        "roofed": roofed_block(0.05),
        "hexagon": prism(hexagon, 0.05),
    }


def model_of(name: str) -> ObjectModel:
    """The exact model of an object."""
    return solids()[name].exact_model(name)


def calibrated(seed: int) -> dict[str, Rig]:
    """A cell with its staged and its joint calibration."""
    cell = SimulatedCell(seed)
    rng, truth = np.random.default_rng((seed, 31)), cell.truth.calibration.uncorrected
    points, commands, pixels = cell.board.points, [], []
    while len(commands) < BOARD_VIEWS:
        tilt, azimuth, roll = rng.uniform(0.0, 0.6), *rng.uniform(0.0, 2.0 * np.pi, 2)
        aim = cell.centre + np.append(rng.uniform(-0.05, 0.05, 2), 0.0)
        wanted = look_at_from_above(aim, rng.uniform(0.36, 0.6), tilt, azimuth, roll)
        try:
            commands.append(cell.move(host_matrices(truth.command_for(wanted))))
        except CellError:
            continue
        actual = host_transforms(cell.judge_tool())
        seen = np.asarray(truth.project(actual, points)[0])
        beyond = np.array(truth.camera.image_size) - 1.0
        inside = np.logical_and(seen > 0.0, seen < beyond).all(axis=1)
        seen = seen + PIXEL_NOISE * rng.standard_normal(seen.shape)
        pixels.append(np.where(np.asarray(inside)[:, None], seen, np.nan))
    stacked = stacked_commands(commands)
    data = sv.Dataset.from_arrays(
        points,
        np.stack(pixels),
        stacked.base_from_tool,
        image_size=truth.camera.image_size,
        target=cell.board,
        joints=stacked.joints,
        arm=cell.arm,
    )
    fit = sv.calibrate(data)
    return {
        "joint": Rig(cell, fit.calibration, fit.joint),
        "staged": Rig(cell, fit.staged.calibration, None),
    }


def scene_of(rig: Rig) -> GraspScene:
    """What is known around an object in the bin."""
    walls = [
        Obstacle.box(fixture.name, fixture.size, fixture.world_from_box)
        for fixture in rig.cell.fixtures
    ]
    return GraspScene(
        rig.calibration,
        (Obstacle.table(), *walls),
        arm=rig.cell.arm,
        near=np.asarray(rig.cell.where().joints),
        estimate=rig.estimate,
        link_radius=0.04,
    )


def measured(rig: Rig, name: str, scale: float, rng: np.random.Generator) -> Measured:
    """The object in the cell, measured from two views with errors of a known covariance.

    The pictures are exact; what calibration and robot make of them is not, and is propagated.
    """
    cell, truth = rig.cell, rig.cell.truth.calibration.uncorrected
    world_from_object = cell.judge().world_from_object[name]
    commands, poses, camera_from_object = [], [], []
    for azimuth in (0.6, 2.3):
        wanted = look_at_from_above(cell.centre, 0.45, 0.38, azimuth)
        commands.append(cell.move(host_matrices(truth.command_for(wanted))))
        actual = host_matrices(truth.camera_from_world(host_transforms(cell.judge_tool())))
        camera_from_object.append(actual @ world_from_object)
        command = Command(commands[-1].base_from_tool, commands[-1].joints)
        believed = host_matrices(rig.calibration.camera_from_world(command))
        poses.append(np.linalg.inv(believed) @ camera_from_object[-1])
    mean = mean_matrix(np.stack(poses), np.ones(len(poses)))
    covariance = scale**2 * SPREAD
    error = rng.multivariate_normal(np.zeros(6), covariance)
    jacobian, names = None, ()
    if rig.estimate is not None:
        views = SeenViews.of(rig.calibration, stacked_commands(commands))
        known = CalibrationUncertainty.of(views, rig.calibration, rig.estimate)
        # exp(t) camera_from_world moves the object's tangent by -Ad(object_from_camera) t.
        own = [-host_adjoints(np.linalg.inv(pose)) for pose in camera_from_object]
        by_number = np.mean([a @ known.view_jacobian[k, -6:] for k, a in enumerate(own)], axis=0)
        jacobian, names = by_number[:, : known.shared_count], known.shared_names
        covariance = covariance + by_number @ known.covariance @ by_number.T
    return Measured(model_of(name), mean @ host_exponentials(error), covariance, jacobian, names)


def attempt(rig: Rig, name: str, scale: float, seed: int) -> tuple[float, bool] | None:
    """Predicted probability of the best grasp and whether it held; None if none is possible."""
    cell = rig.cell
    cell.set_gripper(cell.gripper.max_opening)
    cell.drop([CellObject(name, solids()[name])], seed)
    found = measured(rig, name, scale, np.random.default_rng((seed, 32)))
    try:
        plan = grasps_for(found, cell.gripper, scene_of(rig), Motion(min_probability=0.0))
        best = plan.best
    except NoSafeGraspError:
        return None
    try:
        execute(cell, best)
        held = name in cell.judge().held
    except CellError:
        held = False
    return best.success_probability, held


def interval(successes: int, count: int) -> tuple[float, float]:
    """The 95 % interval of Clopper and Pearson of a probability."""
    low = beta.ppf(0.025, successes, count - successes + 1) if successes else 0.0
    high = beta.ppf(0.975, successes + 1, count - successes) if successes < count else 1.0
    return float(low), float(high)


def reliability(
    rigs: list[dict[str, Rig]], drops: int, names: Sequence[str], scales: Sequence[float]
) -> bool:
    """Print predicted probabilities and what happened; True if they agree."""
    agreed = True
    for kind in ("joint", "staged"):
        results: list[tuple[float, bool]] = []
        impossible = 0
        cases = [
            (rig[kind], name, scale, 1000 * r + d)
            for r, rig in enumerate(rigs)
            for d in range(drops)
            for scale in scales
            for name in names
        ]
        for case in track(cases, f"{kind}: grasps", disable=len(cases) < 20):
            result = attempt(*case)
            impossible += result is None
            results += [] if result is None else [result]
        print(f"\n{kind} calibration: {len(results)} grasps executed, {impossible} with no way in")
        print("  predicted          grasps  mean predicted  held   95 % interval")
        for low, high in pairwise(BINS):
            inside = [(p, h) for p, h in results if low < p <= high or (p == low == 0.0)]
            if inside:
                held = sum(h for _, h in inside)
                a, b = interval(held, len(inside))
                mean = np.mean([p for p, _ in inside])
                print(
                    f"  {low:4.0%} to {high:4.0%}  {len(inside):12}  {mean:14.1%}"
                    f"  {held / len(inside):5.1%}  {a:.1%} to {b:.1%}"
                )
        small = [h for p, h in results if p > 0.95]
        if kind == "joint" and len(small) >= 20:
            agreed &= np.mean(small) >= 0.95
    return bool(agreed)


def picking(rigs: list[dict[str, Rig]], drops: int, objects: int) -> bool:
    """Print how often an object was picked from pictures; True if the joint fit's claim holds."""
    names, ok = list(solids()), True
    for kind in ("joint", "staged"):
        accepted = executed = held = 0
        outcomes = []
        for r, rig in enumerate(rigs):
            cell = rig[kind].cell
            region = Region(cell.centre, (0.24, 0.18, 0.12))
            for d in track(range(drops), f"{kind}: picks", disable=drops < 5):
                chosen = [names[(d + k) % len(names)] for k in range(objects)]
                cell.set_gripper(cell.gripper.max_opening)
                cell.drop([CellObject(name, solids()[name]) for name in chosen], 2000 * r + d)
                models = [model_of(name) for name in chosen]
                result = pick(cell, models, cell.gripper, region, scene_of(rig[kind]))
                accepted += result.look is not None and len(result.look.found.accepted) > 0
                executed += result.grasp is not None
                good = result.target is not None and result.target.model.name in cell.judge().held
                held += good
                if not good:
                    outcomes.append(result.outcome)
        total = drops * len(rigs)
        low, high = interval(held, executed) if executed else (0.0, 1.0)
        print(
            f"{kind} calibration: {total} scenes of {objects}, accepted in {accepted}, executed in "
            f"{executed}, held in {held} ({low:.1%} to {high:.1%} of those executed)"
        )
        for text in outcomes[:8]:
            print(f"    {text[:160]}")
        if kind == "joint" and executed >= 20:
            ok &= held >= 0.95 * executed
    return ok


def run(smoke: bool = False) -> bool:
    """Print both tables; True where the claims hold."""
    rigs = [calibrated(seed) for seed in range(1 if smoke else 4)]
    if smoke:
        agreed = reliability(rigs, 1, ("stepped",), SCALES[:2])
    else:
        agreed = reliability(rigs, 3, tuple(solids()), SCALES)
    print("\npicked from rendered pictures")
    return picking(rigs, 1 if smoke else 10, 1) and agreed
