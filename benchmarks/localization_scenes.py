"""Rendered scenes with known truth for the localisation of objects: single, cluttered, occluded.

Two pictures of 1280 x 960 px from some 0.4 m, through a lens with distortion. The object rests on a
table, or is tilted as if it leaned on something.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5
from smartview_jax.geometry import host_matrices, look_at
from smartview_jax.localization import Wireframe, predict_view
from smartview_jax.modeling import ObjectModel
from smartview_jax.runtime.compilation import compiled
from smartview_jax.simulation import (
    Polyhedron,
    SolidScene,
    Surface,
    box,
    labelled,
    matt,
    random_polyhedron,
    render_solids,
    roofed_block,
    speckled,
    stepped_block,
)
from smartview_jax.simulation.ray_casting import MISSED, RayCaster
from smartview_jax.simulation.textures import Texture

KINDS = ("single", "tilted", "clutter", "occluded")

OCCLUSION = 0.3
"""Hidden share of the edges' visible length in a scene of the kind "occluded", about."""

DISTANCE = (0.36, 0.46)
"""Distances of the cameras from the object, m."""

ROWS, CELL_ROWS = 960, 800
"""Heights of the pictures of these scenes, and of the simulated cell's, px."""

predicted = compiled(predict_view)


class LocalizationScene(NamedTuple):
    """Pictures of one object, and the truth behind them.

    Attributes:
        name: of the object.
        kind: one of `KINDS`.
        calibration: the true calibration; tool and camera are one frame, and so are base and world.
        base_from_tool: true poses of the views.
        pictures: grey.
        model: of the object, exact, with its symmetry.
        world_from_object: the true pose.
        hidden: share of the edges' visible length that something else hides, for each view.
    """

    name: str
    kind: str
    calibration: sv.Calibration
    base_from_tool: np.ndarray
    pictures: list[np.ndarray]
    model: ObjectModel
    world_from_object: np.ndarray
    hidden: np.ndarray


def solids() -> dict[str, Polyhedron]:
    """Return the five objects, two of them symmetric, of 50 to 70 mm."""
    return {
        "stepped": stepped_block(0.06),
        "roofed": roofed_block(0.05),
        "box": box(0.06, 0.04, 0.03),
        "random12": random_polyhedron(np.random.default_rng(12), 12, 0.026),
        "random14": random_polyhedron(np.random.default_rng(14), 14, 0.028),
    }


def camera(rows: int = ROWS) -> sv.Camera:
    """Return the camera of all scenes, with pictures of a height in px."""
    lens = OpenCV5(-0.12, 0.05, 3e-4, -2e-4, 0.0)
    return sv.Camera(1500.0, 1505.0, 645.0, 0.5 * rows - 8.0, lens, (1280, rows))


def printed_table(labels: int, seed: int, rng: np.random.Generator) -> Texture:
    """Return the texture of a table with fine grain and printed labels."""
    table = speckled(rng.uniform(0.3, 0.5), 0.03, 0.004, seed=seed + 1)
    return labelled(table, labels, 0.03, 0.15, seed=seed)


def plain_surfaces(solids: list[Polyhedron], rng: np.random.Generator) -> list[Surface]:
    """Return solids of one shade each, as a camera sees them."""
    return [Surface.of_polyhedron(solid, matt(rng.uniform(0.2, 0.8))) for solid in solids]


def localization_scene(
    name: str, kind: str, seed: int, samples: int = 8, view_count: int = 2, rows: int = ROWS
) -> LocalizationScene:
    """Return one scene, rendered in a second or two."""
    rng = np.random.default_rng((seed, KINDS.index(kind), sorted(solids()).index(name)))
    solid, calibration = (
        solids()[name],
        sv.Calibration.eye_in_hand(camera(rows), np.eye(4), np.eye(4)),
    )
    world_from_object = resting(solid, rng) if kind != "tilted" else _tilted(solid, rng)
    placed = solid.moved(world_from_object)
    poses = viewpoints(placed.vertices.mean(axis=0), rng, view_count)
    others = []
    if kind in ("clutter", "occluded"):
        others += clutter(placed, rng)
    model = solid.exact_model(name)
    if kind == "occluded":
        others.append(occluder(model, world_from_object, poses, calibration, rng, others))
    grain = speckled(rng.uniform(0.55, 0.8), rng.uniform(0.0, 0.03), 0.003, seed=seed)
    printed = printed_table(12 if kind in ("single", "tilted") else 30, seed, rng)
    surfaces = [Surface.of_plane(0.5, printed), Surface.of_polyhedron(placed, grain)]
    surfaces += plain_surfaces(others, rng)
    pictures = [
        render_solids(
            calibration, pose, SolidScene(surfaces), exposure=1.2, seed=seed + k, samples=samples
        )
        for k, pose in enumerate(poses)
    ]
    hidden = hidden_shares(model, world_from_object, poses, calibration, others)
    return LocalizationScene(
        name, kind, calibration, poses, pictures, model, world_from_object, hidden
    )


def hidden_shares(
    model: ObjectModel,
    world_from_object: np.ndarray,
    poses: np.ndarray,
    calibration: sv.Calibration,
    others: list[Polyhedron],
) -> np.ndarray:
    """Return the share of the visible edges that other solids hide in each view."""
    if not others:
        return np.zeros(len(poses))
    wireframe = Wireframe.of(model)
    starts = np.cumsum([0] + [len(one.vertices) for one in others[:-1]])
    caster = RayCaster(
        np.concatenate([one.vertices for one in others]),
        np.concatenate([one.triangles + s for one, s in zip(others, starts, strict=True)]),
    )
    shares = []
    for pose in poses:
        view = predicted(wireframe, calibration.camera, np.linalg.inv(pose) @ world_from_object)
        seen, px = np.asarray(view.sample_visible), np.asarray(view.sample_px)
        points = np.asarray(wireframe.samples) @ world_from_object[:3, :3].T
        rays = points + world_from_object[:3, 3] - pose[:3, 3]
        hits = caster.first_hits(pose[:3, 3], rays)
        nearer = np.linalg.norm(hits.points - pose[:3, 3], axis=1) < np.linalg.norm(rays, axis=1)
        covered = (hits.triangle != MISSED) & nearer
        shares.append(px[seen & covered].sum() / max(px[seen].sum(), 1e-9))
    return np.array(shares)


def resting(solid: Polyhedron, rng: np.random.Generator) -> np.ndarray:
    """Return a random pose on the table, the object resting on a side of its convex hull."""
    hull = ConvexHull(solid.vertices)
    centre = solid.vertices[hull.vertices].mean(axis=0)
    turn, lowest = np.eye(3), 0.0
    for k in rng.permutation(len(hull.equations)):
        normal = hull.equations[k, :3]
        turn = Rotation.align_vectors([[0.0, 0.0, -1.0]], [normal])[0].as_matrix()
        turned = (solid.vertices - centre) @ turn.T
        lowest = float(turned[:, 2].min())
        foot = turned[turned[:, 2] < lowest + 1e-6]
        # It stands where the middle of its vertices is above the hull of its foot.
        if len(foot) >= 3 and (ConvexHull(foot[:, :2]).equations[:, 2] < -1e-3).all():
            break
    spin = Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi)).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = spin @ turn
    pose[:3, 3] = -pose[:3, :3] @ centre + [*rng.uniform(-0.02, 0.02, 2), -lowest]
    return pose


def _tilted(solid: Polyhedron, rng: np.random.Generator) -> np.ndarray:
    """Return a random pose above the table, touching it with one vertex."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    pose[2, 3] = 1e-3 - (solid.vertices @ pose[:3, :3].T)[:, 2].min()
    pose[:2, 3] = rng.uniform(-0.02, 0.02, 2)
    return pose


def viewpoints(aim: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return poses of cameras that look at the object from above, 20 to 35 degrees apart."""
    tilt, azimuth = rng.uniform(0.25, 0.75), rng.uniform(0.0, 2.0 * np.pi)
    poses = []
    for k in range(count):
        # Each further view is on the next side of the first one.
        apart = 0.0 if k == 0 else np.deg2rad(rng.uniform(20.0, 35.0)) * (1 if k % 2 else -1)
        a, t = azimuth + apart / np.sin(max(tilt, 0.5)), tilt
        direction = -np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
        target = aim + rng.uniform(-0.02, 0.02, 3)
        pose = look_at(target, direction, rng.uniform(*DISTANCE), rng.uniform(-np.pi, np.pi))
        poses.append(np.linalg.inv(host_matrices(pose)))
    return np.array(poses)


def clutter(placed: Polyhedron, rng: np.random.Generator) -> list[Polyhedron]:
    """Return five boxes and blocks around the object."""
    centre, radius = placed.vertices.mean(axis=0), np.ptp(placed.vertices[:, :2], axis=0).max() / 2
    others = []
    for k in range(5):
        size = rng.uniform(0.015, 0.045, 3) * [1.0, 1.0, 0.7]
        one = box(*size) if k % 2 else roofed_block(float(size[0]))
        angle = 2.0 * np.pi * (k + rng.uniform(-0.3, 0.3)) / 5
        reach = radius + 0.6 * float(np.hypot(size[0], size[1])) + rng.uniform(0.004, 0.03)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", rng.uniform(0.0, 2.0 * np.pi)).as_matrix()
        pose[:2, 3] = centre[:2] + reach * np.array([np.cos(angle), np.sin(angle)])
        others.append(one.moved(pose))
    return others


def similar_solids(
    solid: Polyhedron, centre: np.ndarray, rng: np.random.Generator
) -> list[Polyhedron]:
    """Return six solids about a point that are like a solid but for one or two of their sizes."""
    found = []
    for k in range(6):
        stretch, axes = np.ones(3), rng.permutation(3)[: rng.integers(1, 3)]
        shorter, longer = rng.uniform(0.6, 0.9, len(axes)), rng.uniform(1.12, 1.5, len(axes))
        stretch[axes] = np.where(rng.random(len(axes)) < 0.5, shorter, longer)
        angle, reach = 2.0 * np.pi * (k + rng.uniform(-0.3, 0.3)) / 6, rng.uniform(0.05, 0.075)
        own = solid._replace(vertices=solid.vertices * stretch)
        pose = resting(own, rng)
        pose[:2, 3] += centre[:2] + reach * np.array([np.cos(angle), np.sin(angle)])
        found.append(own.moved(pose))
    return found


def occluder(
    model: ObjectModel,
    world_from_object: np.ndarray,
    poses: np.ndarray,
    calibration: sv.Calibration,
    rng: np.random.Generator,
    others: list[Polyhedron],
) -> Polyhedron:
    """Return a bar before the object that hides about `OCCLUSION` of its edges in all views."""
    centre = (model.vertices @ world_from_object[:3, :3].T + world_from_object[:3, 3]).mean(axis=0)
    towards = poses[:, :3, 3].mean(axis=0) - centre
    best, best_cost = None, np.inf
    for _ in range(60):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
        aside = np.cross(towards, rng.standard_normal(3))
        aside *= rng.uniform(0.0, 0.04) / np.linalg.norm(aside)
        pose[:3, 3] = centre + rng.uniform(0.1, 0.2) * towards + aside
        bar = box(0.012, 0.03, 0.08).moved(pose)
        shares = hidden_shares(model, world_from_object, poses, calibration, [*others, bar])
        cost = np.abs(shares - OCCLUSION).max()
        if cost < best_cost:
            best, best_cost = bar, cost
    assert best is not None
    return best
