"""One scene of the localisation benchmark: what is found in it, by which calibration, how exactly.

Each scene is searched with the true calibration, and with the joint and the staged one of a cell
that was calibrated from 20 views of a board. Also run are OpenCV's `solvePnPRansac` on the
same matched corners, and a third picture from the paper's verification view or the chosen one.
"""

import time
from typing import Any

import cv2
import jax
import numpy as np

import smartview_jax as sv
from smartview_jax.features import PictureEvidence, picture_evidence
from smartview_jax.geometry import host_logarithms
from smartview_jax.localization import (
    FIT_SAMPLES,
    EdgeLookup,
    Localization,
    Localizations,
    Reachable,
    Wireframe,
    localize,
    next_view,
)
from smartview_jax.localization.refining.pose_equations import line_equations
from smartview_jax.localization.refining.refinement import measured_lines
from smartview_jax.modeling import CalibrationUncertainty, ObjectModel, SeenViews
from smartview_jax.picking.calibrating import stacked_commands

from .grasping import Rig
from .hypotheses import pose_errors
from .localization_cells import (
    CellScene,
    View,
    cell_scene,
    taken,
    true_calibration,
    walls_of,
    workspace_of,
)
from .localization_scenes import solids

RIGHT = (3.0, 5e-3)
"""Largest errors of a right pose, degrees and m; a calibration alone may put it off by 1 mm."""

BOUND_RADIUS = 1.5
"""Distance of edge points from the true edges within which they count for the bound, px."""

GRAIN_CURVATURE = 0.11
"""What the surfaces' grain displaces a whole edge by, px, times its gradient, grey levels/px.

Next to a blurred step of peak gradient g and width s, other brightness b moves the peak to where
-g x / s^2 + b''(0) = 0, by x = s^2 b'' / g. Grain is coarser than the spacing of edge points, so
that the points of an edge share most of it, however many they are. At the true poses of 54 scenes
of other seeds the edges' distances and tilts have the spread of their points' noise and of 0.106
and 0.108 over g, 0.09 to 0.15 in each band of g below 20. In pictures without noise the tilts of
edges with g below 7 are 0.024 px in the median, and 0.004 px once the grain is left out.
"""

CORNER_REACH = 3.0
"""Distance of a corner from a predicted vertex within which it is its match, px."""

VIEWED_EVERY = 8
"""Of so many scenes one has third views; besides those in which two views leave a pose open."""

THIRD_DISTANCE = 0.42
"""Distance of third views, m."""


def trial(rigs: dict[str, Rig], kind: str, seed: int) -> dict[str, Any]:
    """Return what is found in one scene as a record of plain numbers."""
    cell = rigs["joint"].cell
    scene = cell_scene(cell, kind, seed)
    models = _models(scene)
    record: dict[str, Any] = {"kind": kind, "seed": seed, "hidden": scene.hidden.tolist()}
    record["objects"] = [one.name for one in scene.objects]
    truth = true_calibration(cell)
    actual = np.stack([view.base_from_tool for view in scene.views])
    began = time.perf_counter()
    evidence = _evidence(scene.views, truth)
    workspace = workspace_of(cell)
    localizations = localize(evidence, actual, truth, models, workspace=workspace)
    record["seconds"] = time.perf_counter() - began
    record["true"] = _judged(scene, localizations)
    record["bound"], record["pnp"] = _beside(scene, localizations, evidence, truth, actual)
    commands = stacked_commands([view.command for view in scene.views])
    for name in ("joint", "staged"):
        rig = rigs[name]
        own = localize(
            _evidence(scene.views, rig.calibration),
            commands,
            rig.calibration,
            models,
            covariance=rig.estimate,
            workspace=workspace,
        )
        record[name] = _judged(scene, own)
    if localizations.open or (scene.objects and seed % VIEWED_EVERY == 0):
        record["third"] = _third_views(rigs, scene, localizations, models)
    return record


def _models(scene: CellScene) -> list[ObjectModel]:
    """Return the models to look for: of present and of absent objects."""
    there = {} if scene.kind == "wrong" else {one.name: one for one in scene.objects}
    return [*there.values(), *(solids()[name].exact_model(name) for name in scene.others)]


def _evidence(views: list[View], calibration: sv.Calibration) -> list[PictureEvidence]:
    """Return what is found in the pictures."""
    return [picture_evidence(view.picture, calibration.camera) for view in views]


def _nearest(scene: CellScene, one: Localization) -> tuple[int | None, float, float]:
    """Return the true object of a model that is nearest to a pose, and degrees and m to it."""
    best = (None, np.inf, np.inf)
    for k, (model, truth) in enumerate(zip(scene.objects, scene.world_from_object, strict=True)):
        if model.name == one.model.name:
            angle, shift = (
                float(x[0]) for x in pose_errors(model, one.world_from_object[None], truth)
            )
            if shift < best[2]:
                best = (k, angle, shift)
    return best


def is_right(angle: float, shift: float) -> bool:
    """Return whether a pose is right, by its errors in degrees and m."""
    return angle < RIGHT[0] and shift < RIGHT[1]


def _judged(scene: CellScene, found: Localizations) -> list[dict[str, Any]]:
    """Return each localisation with its verdict and its error."""
    results = []
    for one in found:
        k, angle, shift = _nearest(scene, one)
        result: dict[str, Any] = {
            "model": one.model.name,
            "decision": one.verdict.decision,
            "object": k,
            "right": is_right(angle, shift),
            "degrees": angle,
            "mm": 1e3 * shift,
            "explained": one.verdict.evidence.explained,
            "false_alarms": one.verdict.log_false_alarms,
            "margin": one.verdict.margin,
            "reasons": list(one.verdict.reasons),
        }
        if k is not None and result["right"]:
            error = _tangent(one, scene.world_from_object[k])
            result["nees"] = float(error @ np.linalg.solve(one.covariance, error))
            result["edge_sigma"] = one.refined.edge_sigma
        results.append(result)
    return results


def _tangent(one: Localization, truth: np.ndarray) -> np.ndarray:
    """Return the tangent at the found pose that leads to the truth, up to symmetry."""
    equal = truth @ one.model.object_from_object
    errors = host_logarithms(np.linalg.inv(one.world_from_object) @ equal)
    return errors[int(np.argmin(np.linalg.norm(errors[:, 3:], axis=1)))]


def _beside(
    scene: CellScene,
    found: Localizations,
    evidence: list[PictureEvidence],
    calibration: sv.Calibration,
    poses: np.ndarray,
) -> tuple[list[dict[str, float]], list[dict[str, Any]]]:
    """Return the bound and OpenCV's answer for each right accepted pose."""
    bounds, peers = [], []
    views = SeenViews.of(calibration, poses)
    # The bound counts all points of an edge, also those that another edge displaces.
    lookup = EdgeLookup.of(
        [one.edge_points for one in evidence],
        calibration.camera.image_size,
        lone=[np.ones_like(one.lone) for one in evidence],
    )
    for one in found.accepted:
        k, angle, shift = _nearest(scene, one)
        if k is None or not is_right(angle, shift):
            continue
        true_pose = scene.world_from_object[k]
        bound: dict[str, float] = {"own_mm": 1e3 * shift, "own_degrees": angle}
        bound["hidden"] = float(scene.hidden[k].mean())
        for prefix, grain in (("grain_", GRAIN_CURVATURE), ("points_", 0.0)):
            covariance = bound_covariance(one.model, views, lookup, true_pose, grain)
            bound |= _sizes(covariance, one.model, prefix)
        bounds.append(bound)
        peers.append(_pnp(one, views, evidence, scene.world_from_object[k]))
    return bounds, peers


def _sizes(covariance: np.ndarray, model: ObjectModel, prefix: str) -> dict[str, float]:
    """Return the RMS errors of a pose of a given covariance: of its middle and of its turn."""
    x, y, z = model.vertices.mean(axis=0)
    lever = np.eye(6)[:3]
    lever[:, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return {
        f"{prefix}mm": 1e3 * float(np.sqrt(np.trace(lever @ covariance @ lever.T))),
        f"{prefix}degrees": float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))),
    }


def bound_covariance(
    model: ObjectModel,
    views: SeenViews,
    lookup: EdgeLookup,
    world_from_object: np.ndarray,
    grain: float = GRAIN_CURVATURE,
) -> np.ndarray:
    """Return the covariance of a pose from perfect correspondences of its visible edge points.

    Every edge is measured where it truly is: its edge points have the scatter that is seen about
    their own line, one in 3.5 px counting as independent, the grain of the surfaces displaces it
    (`GRAIN_CURVATURE`; zero for the bound of the points' noise alone), and nothing else errs.
    """
    wireframe = Wireframe.of(model, FIT_SAMPLES)
    lines = measured_lines(wireframe, views, lookup, world_from_object, BOUND_RADIUS)
    exact = CalibrationUncertainty.none(views)
    equations = line_equations(lines, model, wireframe, views, world_from_object, exact)
    # Of the two numbers of an edge both have the noise of its points, independently.
    of_points = np.diagonal(equations.noise)[::2]
    of_grain = (grain / np.maximum(lines.strength[lines.measured], 1e-3)) ** 2
    variances = np.repeat(np.maximum(of_points, 1e-8) + of_grain, 2)
    J = equations.by_pose
    return np.linalg.inv(J.T @ (J / variances[:, None]))


def _pnp(
    one: Localization, views: SeenViews, evidence: list[PictureEvidence], truth: np.ndarray
) -> dict[str, Any]:
    """Return OpenCV's pose from the corners that match the vertices, in the view with most."""
    best: dict[str, Any] = {"corners": 0}
    lens = views.cameras[0]
    matrix = np.array(
        [[lens.alpha_u, 0.0, lens.u0], [0.0, lens.alpha_v, lens.v0], [0.0, 0.0, 1.0]], dtype=float
    )
    distortion = np.array(jax.tree.leaves(lens.lens), dtype=float)
    for k, camera_from_world in enumerate(views.camera_from_world):
        camera_from_object = camera_from_world @ one.world_from_object
        rotation = cv2.Rodrigues(camera_from_object[:3, :3])[0]
        predicted = cv2.projectPoints(
            one.model.vertices, rotation, camera_from_object[:3, 3], matrix, distortion
        )[0][:, 0]
        gaps = np.linalg.norm(evidence[k].features.corners[None] - predicted[:, None], axis=2)
        near = np.flatnonzero(gaps.min(axis=1, initial=np.inf) < CORNER_REACH)
        if len(near) < 4 or len(near) <= best["corners"]:
            continue
        corners = evidence[k].features.corners[gaps[near].argmin(axis=1)]
        solved, turn, shift, _ = cv2.solvePnPRansac(
            one.model.vertices[near], corners, matrix, distortion, reprojectionError=2.0
        )
        best = {"corners": len(near), "solved": bool(solved)}
        if solved:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
            world_from_object = np.linalg.inv(camera_from_world) @ pose
            angle, error = pose_errors(one.model, world_from_object[None], truth)
            best |= {"degrees": float(angle[0]), "mm": 1e3 * float(error[0])}
    return best


def _third_views(
    rigs: dict[str, Rig], scene: CellScene, found: Localizations, models: list[ObjectModel]
) -> dict[str, Any]:
    """Return what a third picture makes of a scene, from the paper's view and the chosen one."""
    cell, truth = rigs["joint"].cell, true_calibration(rigs["joint"].cell)
    # What is left open is what a further view is for.
    looked_at = found.open or found.accepted[:1]
    if not looked_at:
        return {}
    try:
        chosen = next_view(
            looked_at, truth, Reachable(distance=THIRD_DISTANCE), models=models,
            neighbours=found, occluders=walls_of(cell, scene.kind),
        )  # fmt: skip
    except ValueError:
        return {}
    result: dict[str, Any] = {"before": _judged(scene, found)}
    for name, view in (("chosen", chosen), ("paper", chosen.paper)):
        if view is None:
            continue
        third = taken(cell, scene, view.camera_from_world, scene.seed + 5)
        if third is None:
            continue
        try:
            evidence = _evidence([third], truth)
        except ValueError:
            # Where nothing is, the picture is blank.
            continue
        own = localize(
            evidence, third.base_from_tool[None], truth, models,
            previous=found, workspace=workspace_of(cell),
        )  # fmt: skip
        result[name] = _judged(scene, own)
    return result
