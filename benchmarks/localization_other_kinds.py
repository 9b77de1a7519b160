"""Known objects of other kinds: bars, plates, channels, round parts, neighbours, many of a kind.

The scenes of `localization` have compact solids of 50 to 70 mm, one of each. Here are solids with
edges of very different lengths, washers and pipes, two equal bars side by side, and sixteen equal
wedges, in two pictures each. Run alone by `python -m benchmarks.localization_other_kinds`.
"""

import argparse
import dataclasses
import sys
import time
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.geometry import host_logarithms
from smartview_jax.io.meshes import model_from_triangles
from smartview_jax.localization import localize
from smartview_jax.modeling import Face, ObjectModel, find_symmetry
from smartview_jax.simulation import (
    Polyhedron,
    SolidScene,
    Surface,
    box,
    prism,
    render_solids,
    speckled,
)

from .hypotheses import pose_errors
from .localization_scenes import camera, printed_table, resting, viewpoints
from .localization_trials import is_right

SCENES = {
    "bar150": 6, "bar50": 6, "plate": 6, "channel": 6, "apart25": 6, "apart50": 6, "wedges": 2,
    "washer": 12, "pipe": 12, "ring": 6,
}  # fmt: skip
"""Number of scenes of each kind; "apart" are two long bars side by side, so many mm apart."""

WEDGE_SPACING = 0.045
"""Distance of neighbouring wedges in their square, m."""


class KindScene(NamedTuple):
    """Pictures of equal objects on a table, and their true poses."""

    model: ObjectModel
    world_from_object: list[np.ndarray]
    pictures: list[np.ndarray]
    base_from_tool: np.ndarray
    calibration: sv.Calibration


class Counts(NamedTuple):
    """What is found in a scene.

    Attributes:
        objects, found, wrong: numbers of objects, of right accepted poses, and of wrong ones.
        millimetres: errors of the middles of right poses, mm.
        nees: normalised squared errors of right poses, 6 each.
        seconds: processor time of the search.
    """

    objects: int
    found: int
    wrong: int
    millimetres: list[float]
    nees: list[float]
    seconds: float


def channel(width: float = 0.03, height: float = 0.02, wall: float = 0.003) -> Polyhedron:
    """Return a U-shaped channel of 60 mm that lies on its back, open upwards."""
    w, h, t = width, height, wall
    profile = [[0, 0], [w, 0], [w, h], [w - t, h], [w - t, t], [t, t], [t, h], [0, h]]
    flat = prism(np.array(profile) - [0.5 * w, 0.0], 0.06)
    y, z, x = flat.vertices.T
    return flat._replace(vertices=np.column_stack([x - 0.03, y, z]))


def wedge() -> Polyhedron:
    """Return a wedge of 24 x 18 x 14 mm."""
    flat = prism(np.array([[-0.5, 0.0], [0.5, 0.0], [-0.5, 0.6]]) * 0.024, 0.018)
    x, z, y = flat.vertices.T
    return flat._replace(vertices=np.column_stack([x, 0.009 - y, z]))


RING = (0.018, 0.006)
"""Radii of a ring, a torus that lies on the table, m: of the circle in its middle and its tube."""

ROUND = {"washer": (0.02, 0.01, 0.006), "pipe": (0.015, 0.01, 0.05)}
"""Outer and inner radius, and height, of the round parts, m."""

MODEL_SIDES, REAL_SIDES = 64, 240
"""Sides of a round part's model, whose turns are within `RIGHT`; and of the real part."""

TUBE_SIDES = {MODEL_SIDES: 20, REAL_SIDES: 96}
"""Sides of a ring's tube in its model and in the real one, whose outline is as good as round."""


def tube(outer: float, inner: float, height: float, sides: int) -> tuple[ObjectModel, np.ndarray]:
    """Return a model of a tube along z whose rims are its edges, and its triangles."""
    angles = 2.0 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate(
        [
            np.column_stack([r * circle, np.full(sides, z)])
            for z in (0, height)
            for r in (outer, inner)
        ]
    )
    k = np.arange(sides)
    # Outer and inner rim, at the bottom and at the top.
    rings = [k + sides * number for number in range(4)]
    quads = []
    for a, b in ((0, 2), (3, 1), (2, 3), (1, 0)):
        first, last = np.roll(rings[a], -1), np.roll(rings[b], -1)
        quads.append(np.stack([rings[a], first, last, rings[b]], axis=1))
    walls = [Face(tuple(quad)) for quad in np.concatenate(quads[:2]).tolist()]
    loops = [tuple(ring.tolist()) for ring in rings]
    ends = [Face(loops[0][::-1], (loops[1],)), Face(loops[2], (loops[3][::-1],))]
    edges = np.concatenate([np.column_stack([ring, np.roll(ring, -1)]) for ring in rings])
    triangles = np.concatenate(quads)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    model = ObjectModel(vertices, np.sort(edges, axis=1), (*walls, *ends))
    return dataclasses.replace(model, symmetry=find_symmetry(model)), triangles


def round_mesh(kind: str, sides: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and triangles of a round part with so many sides about its axis."""
    if kind == "ring":
        mesh = trimesh.creation.torus(scale * RING[0], scale * RING[1], sides, TUBE_SIDES[sides])
        return mesh.vertices, mesh.faces
    outer, inner, height = ROUND[kind]
    model, triangles = tube(scale * outer, scale * inner, height, sides)
    return model.vertices, triangles


def round_model(kind: str) -> ObjectModel:
    """Return the model of a round part; a ring has no edges."""
    if kind == "ring":
        model = model_from_triangles(*round_mesh(kind, MODEL_SIDES))
    else:
        model = tube(*ROUND[kind], MODEL_SIDES)[0]
    return dataclasses.replace(model, name=kind)


SOLIDS = {
    "bar150": box(0.15, 0.01, 0.014),
    "bar50": box(0.05, 0.01, 0.014),
    "plate": box(0.08, 0.05, 0.003),
    "channel": channel(),
    "wedges": wedge(),
}


def kind_scene(kind: str, seed: int, seen_by: sv.Camera | None = None) -> KindScene:
    """Return a scene of a kind; the same seed gives the same one."""
    # By the name, so that further kinds leave the scenes of these as they are.
    rng = np.random.default_rng((seed, sum(kind.encode())))
    if kind in ("ring", *ROUND):
        return _round_scene(kind, seed, rng, seen_by or camera())
    solid = SOLIDS["bar150" if kind.startswith("apart") else kind]
    if kind.startswith("apart"):
        poses = _side_by_side(1e-3 * float(kind.removeprefix("apart")), rng)
    elif kind == "wedges":
        poses = _in_a_square(rng)
    else:
        poses = [resting(solid, rng)]
    placed = [solid.moved(pose) for pose in poses]
    aim = np.mean([one.vertices.mean(axis=0) for one in placed], axis=0)
    cameras = viewpoints(aim, rng, 2)
    calibration = sv.Calibration.eye_in_hand(seen_by or camera(), np.eye(4), np.eye(4))
    surfaces = [Surface.of_plane(0.5, printed_table(12, seed, rng))]
    for k, one in enumerate(placed):
        grain = speckled(rng.uniform(0.55, 0.8), rng.uniform(0.0, 0.03), 0.003, seed=seed + 7 * k)
        surfaces.append(Surface.of_polyhedron(one, grain))
    scene = SolidScene(surfaces)
    pictures = [
        render_solids(calibration, pose, scene, exposure=1.2, seed=seed + k, samples=8)
        for k, pose in enumerate(cameras)
    ]
    return KindScene(solid.exact_model(kind), poses, pictures, cameras, calibration)


def _round_scene(kind: str, seed: int, rng: np.random.Generator, seen_by: sv.Camera) -> KindScene:
    """Return a scene of a round part that stands on the table."""
    # The mean radius of a polygon is r (1 - (pi / n)^2 / 3): with its corners on the circle the
    # real part would lie 0.005 px within its model.
    vertices, triangles = round_mesh(kind, REAL_SIDES, 1.0 + (np.pi / REAL_SIDES) ** 2 / 3.0)
    x, y, angle = rng.uniform([-0.02, -0.02, 0.0], [0.02, 0.02, 6.28]).tolist()
    pose = _on_table(x, y, angle)
    pose[2, 3] = -vertices[:, 2].min()
    placed = vertices @ pose[:3, :3].T + pose[:3, 3]
    cameras = viewpoints(placed.mean(axis=0), rng, 2)
    calibration = sv.Calibration.eye_in_hand(seen_by, np.eye(4), np.eye(4))
    grain = speckled(rng.uniform(0.55, 0.8), rng.uniform(0.0, 0.03), 0.003, seed=seed)
    table = Surface.of_plane(0.5, printed_table(12, seed, rng))
    scene = SolidScene([table, Surface(placed, triangles, grain)])
    pictures = [
        render_solids(calibration, camera_pose, scene, exposure=1.2, seed=seed + k, samples=8)
        for k, camera_pose in enumerate(cameras)
    ]
    return KindScene(round_model(kind), [pose], pictures, cameras, calibration)


def _side_by_side(distance: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Return two parallel poses on the table."""
    angle = rng.uniform(0.0, 6.28)
    across = np.array([-np.sin(angle), np.cos(angle)])
    middle = rng.uniform(-0.01, 0.01, 2)
    places = [middle + side * distance / 2 * across for side in (-1, 1)]
    return [_on_table(float(x), float(y), angle) for x, y in places]


def _in_a_square(rng: np.random.Generator) -> list[np.ndarray]:
    """Return sixteen poses on the table, each turned at random."""
    return [
        _on_table(
            (i - 1.5) * WEDGE_SPACING + rng.uniform(-0.005, 0.005),
            (j - 1.5) * WEDGE_SPACING + rng.uniform(-0.005, 0.005),
            rng.uniform(0.0, 6.28),
        )
        for i in range(4)
        for j in range(4)
    ]


def _on_table(x: float, y: float, angle: float) -> np.ndarray:
    """Return a pose at a place of the table, turned about the vertical."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    pose[:2, 3] = x, y
    return pose


def found_in(scene: KindScene) -> Counts:
    """Return what is found in obj scene."""
    began = time.process_time()
    localizations = localize(scene.pictures, scene.base_from_tool, scene.calibration, scene.model)
    seconds = time.process_time() - began
    right: dict[int, tuple[float, float]] = {}
    wrong = 0
    for obj in localizations.accepted:
        errors = [
            pose_errors(scene.model, obj.world_from_object[None], truth)
            for truth in scene.world_from_object
        ]
        k = int(np.argmin([shift[0] for _, shift in errors]))
        angle, shift = float(errors[k][0][0]), float(errors[k][1][0])
        if not is_right(angle, shift):
            wrong += 1
            continue
        equal = scene.world_from_object[k] @ scene.model.object_from_object
        tangents = host_logarithms(np.linalg.inv(obj.world_from_object) @ equal)
        error = tangents[int(np.argmin(np.linalg.norm(tangents[:, 3:], axis=1)))]
        right[k] = 1e3 * shift, float(error @ np.linalg.solve(obj.covariance, error))
    return Counts(
        len(scene.world_from_object),
        len(right),
        wrong,
        [millimetres for millimetres, _ in right.values()],
        [nees for _, nees in right.values()],
        seconds,
    )


def print_other_kinds(
    scenes: dict[str, int] | None = None, seen_by: sv.Camera | None = None
) -> bool:
    """Print what is found of each kind; True where no accepted pose is wrong."""
    print(
        f"\n{'other kinds':14}{'objects':>9}{'found':>7}{'wrong':>7}{'median mm':>11}"
        f"{'NEES of 6':>11}{'s a search':>12}"
    )
    good = True
    for kind, count in (SCENES if scenes is None else scenes).items():
        parts = [found_in(kind_scene(kind, seed, seen_by)) for seed in range(count)]
        objects = sum(part.objects for part in parts)
        found, wrong = sum(part.found for part in parts), sum(part.wrong for part in parts)
        errors = [error for part in parts for error in part.millimetres]
        nees = [square for part in parts for square in part.nees]
        seconds = [part.seconds for part in parts]
        # Without a right pose there are no errors.
        error, mean = (np.median(errors), np.mean(nees)) if found else (np.nan, np.nan)
        print(
            f"{kind:14}{objects:9}{found:7}{wrong:7}{error:11.4f}{mean:11.2f}"
            f"{np.median(seconds):12.2f}"
        )
        good &= wrong == 0
    return good


def main() -> int:
    parser = argparse.ArgumentParser(description="Known objects of other kinds.")
    parser.add_argument("--kinds", nargs="*", choices=[*SCENES], default=[*SCENES])
    parser.add_argument("--scenes", type=int, help="number of scenes of each kind")
    arguments = parser.parse_args()
    counts = {kind: arguments.scenes or SCENES[kind] for kind in arguments.kinds}
    return 0 if print_other_kinds(counts) else 1


if __name__ == "__main__":
    sys.exit(main())
